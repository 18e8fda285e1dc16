"""Contract: every command has help with an example, is documented, and `--help` is light."""

import ast
import errno
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from json_answers import KEPT

from fieldlum.cli import COMMANDS, main

pytestmark = pytest.mark.contract

DOCS = Path(__file__).parents[1] / "docs"
PACKAGE = Path(__file__).parents[1] / "fieldlum"
CONTEXT = click.Context(main)
PRESENT = main.list_commands(CONTEXT)


def test_the_docs_list_every_command_in_the_order_of_the_job() -> None:
    sections = re.findall(
        r"^## (\S+)$", (DOCS / "cli.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert [name for name in sections if name in PRESENT] == PRESENT == list(COMMANDS)


# tests/test_bench.py compares the keys of bench with those of train; the others have no kept list.
# A new command is not added here.
WITHOUT_KEPT_KEYS = {
    "bench",
    "compare",
    *(f"calibrate {part}" for part in ("colour", "lens", "linearity", "pixels", "response")),
    *(f"calibrate {part}" for part in ("stray", "vignette")),
    "scene click",
}


def test_the_keys_of_every_other_command_with_json_are_kept() -> None:
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    unkept = {name for name in _with_json(main) if not _is_kept(name, kept)}
    assert unkept == WITHOUT_KEPT_KEYS


def _is_kept(name: str, kept: dict[str, list[str]]) -> bool:
    """Return whether keys are kept under the command's name, with or without a word after it."""
    return any(key == name or key.startswith(f"{name} ") for key in kept)


def _with_json(group: click.Group) -> Iterator[str]:
    """Yield the names of all commands with --json, such as ``calibrate scale``."""
    for name, command in _commands(group, ""):
        if any("--json" in parameter.opts for parameter in command.params):
            yield name


def _commands(group: click.Group, prefix: str) -> Iterator[tuple[str, click.Command]]:
    """Yield all commands that are no groups, by names such as ``calibrate scale``."""
    for name in group.list_commands(CONTEXT):
        command = group.get_command(CONTEXT, name)
        if isinstance(command, click.Group):
            yield from _commands(command, f"{prefix}{name} ")
        elif command is not None:
            yield f"{prefix}{name}", command


@pytest.mark.parametrize("name", PRESENT)
def test_help_has_a_short_first_line_and_an_example(name: str) -> None:
    result = CliRunner().invoke(main, [name, "--help"])
    assert result.exit_code == 0
    command = main.get_command(CONTEXT, name)
    assert command is not None and command.help
    assert len(command.help.strip().splitlines()[0]) <= 70
    assert f"fieldlum {name}" in command.help or isinstance(command, click.Group)


def test_every_option_of_a_docstring_exists() -> None:
    missing = []
    for name, command in _commands(main, ""):
        options = (inspect.getdoc(command.callback) or "").partition("\n\nOptions:\n")[2]
        described = re.findall(r"^  (--[\w-]+)", options, re.MULTILINE)
        existing = {text for option in command.params for text in option.opts}
        missing += [f"{name} {text}" for text in described if text not in existing]
    assert not missing


def test_help_is_light() -> None:
    heavy = (
        "torch",
        "pvlib",
        "cv2",
        "skimage",
        "pandas",
        "matplotlib",
        "scipy",
        "rawpy",
        "OpenEXR",
    )
    code = (
        "import sys, click; from fieldlum.cli import main\n"
        "c = click.Context(main); [main.get_command(c, n) for n in main.list_commands(c)]\n"
        f"print([m for m in {heavy!r} if m in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_an_unknown_command_is_a_usage_error_that_names_its_neighbour() -> None:
    result = CliRunner().invoke(main, ["inf"])
    assert result.exit_code == 2
    assert "Did you mean 'info'?" in result.output


@pytest.mark.parametrize(
    ("code", "expected"), [(errno.EACCES, 3), (errno.ENOSPC, 3), (errno.ENOENT, 1)]
)
def test_what_a_disk_does_is_one_line_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, code: int, expected: int
) -> None:
    """A folder without rights or a full disk is no defect of the tool; a file that it lost is."""
    importlib.import_module("fieldlum.report")  # else modules would keep the patched function

    def trouble(*_: object) -> None:
        raise OSError(code, os.strerror(code), "session/report")

    monkeypatch.setattr("fieldlum.session.open_session", trouble)
    result = CliRunner().invoke(main, ["report", "session"])
    assert result.exit_code == expected
    assert (
        expected != 3 or f"fieldlum report: session/report: {os.strerror(code)}; " in result.output
    )


def test_ctrl_c_ends_with_130_and_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(type(main), "get_command", lambda *_: stopped)
    result = CliRunner().invoke(main, ["info"])
    assert result.exit_code == 130
    assert "start it again to continue" in result.output


def test_every_input_error_says_what_to_do() -> None:
    """The third part of `FILE: found; expected; remedy` is never left out."""
    without = [
        f"{path}:{call.lineno}"
        for path in PACKAGE.rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id == "InputError"
        and len(call.args) < 4
        and "remedy" not in {keyword.arg for keyword in call.keywords}
    ]
    assert not without
