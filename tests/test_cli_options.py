"""Shared options of the command line: one help text each, sizes read strictly."""

import inspect
from collections import defaultdict

import click
import pytest

from fieldlum.cli import main
from fieldlum.cli.options import picture_height

CONTEXT = click.Context(main)
SHARED = ("as_json", "force", "scheduler", "site", "session")


def _commands() -> dict[str, click.Command]:
    found: dict[str, click.Command] = {}
    for name in main.list_commands(CONTEXT):
        command = main.get_command(CONTEXT, name)
        assert command is not None
        parts = command.list_commands(CONTEXT) if isinstance(command, click.Group) else []
        found |= {f"{name} {part}": command.get_command(CONTEXT, part) for part in parts}  # type: ignore[union-attr]
        found |= {} if parts else {name: command}
    return found


@pytest.mark.contract
@pytest.mark.parametrize("parameter", SHARED)
def test_a_shared_option_has_one_help_text(parameter: str) -> None:
    """--site of two commands is a file to plan from; of the others, one meaning and one text."""
    texts = defaultdict(list)
    for name, command in _commands().items():
        for option in command.params:
            if option.name == parameter and isinstance(option, click.Option):
                texts[option.help].append(name)
            elif option.name == parameter and name != "simulate":
                texts[option.make_metavar(CONTEXT)].append(name)
    allowed = 2 if parameter == "as_json" else 1  # one object, or one object per file
    assert len(texts) <= allowed, dict(texts)


@pytest.mark.contract
@pytest.mark.parametrize("name", _commands())
def test_every_option_has_help(name: str) -> None:
    options = [option for option in _commands()[name].params if isinstance(option, click.Option)]
    assert not [option.opts for option in options if not option.help]


@pytest.mark.contract
@pytest.mark.parametrize("name", _commands())
def test_every_help_has_one_form(name: str) -> None:
    """One line that ends with a period, then text, then examples of one line each."""
    text = inspect.cleandoc(_commands()[name].help or "")
    first, _, rest = text.partition("\n\n")
    assert "\n" not in first and first.endswith(".") and len(first) <= 70
    examples = rest.split("Example:\n")[1].splitlines()
    assert all(line.startswith(f"  fieldlum {name} ") for line in examples), examples


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("size", "height"), [("460x230", 230), ("230X115", 115), ("16384x8192", 8192)]
)
def test_a_panorama_is_twice_as_wide_as_high(size: str, height: int) -> None:
    assert picture_height(size) == height


@pytest.mark.contract
@pytest.mark.parametrize(
    "size", ["460", "460x", "x230", "4x2", "460x460", "32768x16384", "-460x-230", "axb"]
)
def test_other_sizes_are_a_usage_error(size: str) -> None:
    with pytest.raises(click.UsageError, match="--size"):
        picture_height(size)
