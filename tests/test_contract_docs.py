"""Contract: every command line that the documentation shows is one that the program accepts."""

from __future__ import annotations

import ast
import importlib
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import pytest
from json_answers import KEPT

from fieldlum import devices
from fieldlum.cli import main
from fieldlum.year.glare.metrics import METRICS

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md")))
_ENDS_A_COMMAND = {"|", "||", "&&", ";", ">", ">>", "<", "2>&1", "&"}


def _shown_lines(text: str) -> Iterator[str]:
    """Yield command lines: of code blocks, and of code within a sentence."""
    for block in re.findall(r"(?ms)^```(?:bash|sh|shell|console)?\n(.*?)^```", text):
        for line in block.replace("\\\n", " ").splitlines():
            yield line.strip().removeprefix("$ ")
    for block in re.findall(r"(?m)(?:^ {4}\S.*\n)+", text):
        for line in block.replace("\\\n", " ").splitlines():
            yield line.strip().removeprefix("$ ")
    without_blocks = re.sub(r"(?ms)^```.*?^```", "", text)
    for code in re.findall(r"(?s)(?<!`)`([^`]+)`(?!`)", without_blocks):
        yield " ".join(code.split())


def _words_of_commands(page: Path) -> Iterator[list[str]]:
    for line in _shown_lines(page.read_text(encoding="utf-8")):
        if not line.startswith("fieldlum "):
            continue
        words = shlex.split(line, comments=True)[1:]
        end = next((i for i, word in enumerate(words) if word in _ENDS_A_COMMAND), len(words))
        if any("..." in word or "…" in word or "[" in word for word in words):
            continue  # a form with placeholders, no command
        yield words[:end]


def _unknown(words: list[str]) -> str | None:
    """Return what the program would not accept, or None."""
    command: click.Command = main
    context = click.Context(main)
    while isinstance(command, click.Group):
        if not words or words[0].startswith("-"):
            return None
        name, *words = words
        below = command.get_command(context, name)
        if below is None:
            return f"no command {name}"
        command = below
        context = click.Context(command, parent=context, info_name=name)
    try:
        options, _, _ = command.make_parser(context).parse_args(words)
    except click.UsageError as error:
        return error.format_message()
    for parameter in command.params:
        value = options.get(parameter.name or "")
        if not isinstance(parameter.type, click.Choice) or not isinstance(value, str):
            continue
        placeholder = value != value.lower()
        if value not in parameter.type.choices and not placeholder:
            return f"{parameter.name}: {value} is not one of {', '.join(parameter.type.choices)}"
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_shown_command_is_accepted(page: Path) -> None:
    refused = {" ".join(words): _unknown(words) for words in _words_of_commands(page)}
    assert not {line: why for line, why in refused.items() if why}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_shown_import_exists(page: Path) -> None:
    for block in re.findall(r"(?ms)^```python\n(.*?)^```", page.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fieldlum"):
                names = ", ".join(name.name for name in node.names)
                exec(f"from {node.module} import {names}", {})  # a submodule is imported too
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "fieldlum":
                assert hasattr(importlib.import_module("fieldlum"), node.attr)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_named_file_of_the_project_exists(page: Path) -> None:
    named = r"`((?:bench|calibration|docs|fieldlum|packaging|tests)/[\w./-]+)`"
    files = re.findall(named, page.read_text(encoding="utf-8"))
    assert [file for file in files if "NAME" not in file and not (ROOT / file).exists()] == []


def test_a_wrong_option_is_found() -> None:
    assert _unknown(["merge", "--no-such-option"])
    assert _unknown(["mergee", "SESSION"]) == "no command mergee"
    assert _unknown(["merge", "SESSION"]) is None


@pytest.mark.slow
def test_names_that_benchmarks_take_from_the_package_exist() -> None:
    missing = []
    for path in sorted((ROOT / "bench").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        modules = {}  # of the package, by the name that the benchmark uses
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fieldlum"):
                for name in node.names:
                    try:
                        exec(f"from {node.module} import {name.name} as found", place := {})
                    except ImportError as error:
                        missing.append(f"{path.name}: {error}")
                        continue
                    if isinstance(place["found"], ModuleType):
                        modules[name.asname or name.name] = place["found"]
        used = (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))
        missing += [
            f"{path.name}: {ast.unparse(node)}"
            for node in used
            if isinstance(node.value, ast.Name)
            and (module := modules.get(node.value.id)) is not None
            and not hasattr(module, node.attr)
        ]
    assert not missing


def test_the_table_of_devices_has_every_driver() -> None:
    text = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    schemes = {*devices.CAMERAS, *devices.PYRANOMETERS, *devices.METERS}
    assert {scheme for scheme in schemes if f"\n| `{scheme}:" not in text} == set()


def test_every_metric_has_its_key_and_every_metric_of_the_year_its_column() -> None:
    keys = json.loads(KEPT.read_text(encoding="utf-8"))["glare"]
    assert {name for name in METRICS if f"views[].{name}" not in keys} == set()
    text = (ROOT / "docs" / "file-formats.md").read_text(encoding="utf-8")
    in_year = (name for name, metric in METRICS.items() if metric.in_year)
    assert {name for name in in_year if f"`{name}@AZ`" not in text} == set()


def test_the_conda_recipe_needs_what_the_package_needs() -> None:
    conda = {
        "matplotlib": "matplotlib-base",
        "opencv-contrib-python-headless": "py-opencv",
        "OpenEXR": "openexr-python",
        "torch": "pytorch",
        "tzdata": "python-tzdata",
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [text.split(";")[0].split(">=") for text in project["dependencies"]]
    recipe = (ROOT / "packaging" / "recipe.yaml").read_text()
    assert re.findall(r"^    - (.+) >=(.+)$", recipe, re.M) == [
        ("python", project["requires-python"][2:]),
        *((conda.get(name, name), least) for name, least in wanted if name != "pyradiance"),
    ]
    assert f'version: "{project["version"]}"' in recipe
