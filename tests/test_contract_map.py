"""Contract: the map of the package is current: picture, package table, and every path named."""

import ast
import importlib.util
import re
import runpy
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PAGES = sorted(
    [*(ROOT / "docs").rglob("*.md"), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md"))]
)
TEXTS = sorted(
    path
    for folder in ("fieldlum", "tests", "docs", "bench", "examples")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".md") and path != Path(__file__)
)
NAMED_PATH = re.compile(
    r"\b(?:fieldlum|docs|tests|bench|examples)/[\w./-]*[\w-]\.(?:py|md|toml|svg)\b"
)
DEFINITION = re.compile(r"`(\w+)` (?:in|of)\s+`(fieldlum/[\w/]+\.py)`")
UNREACHABLE = re.compile(r"\bDESIGN\b|research section|\bissue \d")


@cache
def _drawing():  # type: ignore[no-untyped-def]
    place = ROOT / "docs" / "draw_architecture.py"
    spec = importlib.util.spec_from_file_location("draw_architecture", place)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_picture_is_current() -> None:
    drawing = _drawing()
    kept = drawing.PICTURE.read_text(encoding="utf-8")
    assert kept == drawing.draw(), "run: python docs/draw_architecture.py"


def test_every_package_has_its_line_and_rank() -> None:
    assert _drawing().page() == ARCHITECTURE, "run: python docs/draw_architecture.py"


def test_a_reduced_graph_reaches_the_same() -> None:
    drawing = _drawing()
    edges = {"a": {"b", "c", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}
    assert drawing.reduced(edges) == {"a": {"b"}, "b": {"c"}, "c": {"d"}, "d": set()}


def test_named_paths_exist() -> None:
    missing = []
    for path in TEXTS:
        text = path.read_text(encoding="utf-8")
        names = NAMED_PATH.findall(text)
        missing += [f"{path}: no {name}" for name in names if not (ROOT / name).is_file()]
        missing += [
            f"{path}: {module} has no {name}"
            for name, module in DEFINITION.findall(text)
            if name not in _names_in(ROOT / module)
        ]
    assert not missing


def _names_in(module: Path) -> set[str]:
    tree = ast.parse(module.read_text(encoding="utf-8"))
    return {getattr(node, "name", "") for node in ast.walk(tree)}


def test_texts_cite_pages_that_open() -> None:
    assert not [path for path in TEXTS if UNREACHABLE.search(path.read_text(encoding="utf-8"))]


def test_links_open() -> None:
    closed = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        targets = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", text)
        closed += [f"{page}: {name}" for name in targets if not (page.parent / name).exists()]
    assert not closed


@pytest.mark.contract
def test_the_mutation_sample_names_modules_and_tests_that_exist() -> None:
    bench = runpy.run_path(str(ROOT / "bench" / "mutation_sample.py"))
    for part in bench["PARTS"]:
        assert bench["modules_of"](part)
        assert [name for name in bench["tests_of"](part) if not (ROOT / name).is_file()] == []
