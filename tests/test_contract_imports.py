"""A module imports from ranks above it, or acyclically within its own; stages never import each
other. Every test has a kind.
"""

import ast
import re
from collections.abc import Container, Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

PACKAGE = Path(__file__).parents[1] / "fieldlum"
RANKS = (
    {"core", "learn.model_kinds", "version"},
    {
        "optics.camera_curves",
        "optics.exposure",
        "optics.illuminance",
        "optics.melanopic",
        "optics.projection",
        "optics.stray_light",
        "sky",
    },
    {
        "optics.images",
        "optics.linear_light",
        "optics.profiles",
        "optics.raw",
        "optics.turn_fit",
        "room.scene",
        "session",
        "weather",
    },
    {"core.scheduler", "devices", "sky.sky_view"},
    {
        "calibrate",
        "capture",
        "merge",
        "pair",
        "pair.irradiance",
        "plan",
        "room.simulate",
        "year.glare",
    },
    {
        "bench",
        "learn.models",
        "learn.train",
        "learn.transport",
        "room.fit",
        "year.predict",
        "year.stage_status",
    },
    {"__main__", "api", "cli", "demo", "report", "report.campaign", "web"},
)
RANK = {module: rank for rank, modules in enumerate(RANKS) for module in modules}
STAGES = 4


def _ranked(dotted: str) -> str:
    """Return the innermost ranked package that a name of fieldlum stands in; else the name."""
    parts = dotted.split(".")
    heads = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((head for head in heads if head in RANK), parts[0])


def _module(path: Path) -> str:
    return _ranked(".".join(path.relative_to(PACKAGE).with_suffix("").parts))


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def _imported(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    names = {name.removeprefix("fieldlum.") for name in found if name.startswith("fieldlum.")}
    return {_ranked(name) for name in names if not name.startswith("__")}


ROOMS = {"learn", "optics", "room", "year"}  # whose packages have the ranks
FILES = sorted(p for p in PACKAGE.rglob("*.py") if _module(p) not in {"__init__", *ROOMS})


def test_every_module_has_a_rank() -> None:
    """A module without one: add it to the table, and to the design."""
    assert not [path for path in FILES if _module(path) not in RANK]


def test_imports_point_one_way() -> None:
    """Stages do not import each other: let them meet in records or on disk."""
    wrong = []
    for path in FILES:
        me = _module(path)
        for name in sorted(_imported(path) - {me}):
            below = RANK[name] > RANK[me]
            if below or RANK[me] == RANK[name] == STAGES:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not wrong


def test_no_cycle_within_a_rank() -> None:
    edges = {m: set[str]() for m in RANK}
    for path in FILES:
        edges[_module(path)] |= {n for n in _imported(path) if RANK[n] == RANK[_module(path)]} - {
            _module(path)
        }

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join((*trail, module))
        for name in edges[module]:
            visit(name, (*trail, module))

    for module in RANK:
        visit(module, ())


KINDS = ("analytic", "authority", "property", "contract")


def _marks(node: ast.AST) -> set[str]:
    """Return the kinds that decorators or a pytestmark name."""
    return {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute) and n.attr in KINDS}


def test_every_test_has_a_kind() -> None:
    """A test without a kind: mark it with one of them (pyproject.toml)."""
    bare = []
    for path in sorted(Path(__file__).parent.glob("test_*.py")):
        tree = _tree(path)
        module = [
            node
            for node in tree.body
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"
        ]
        if any(_marks(node) for node in module):
            continue
        bare += [
            f"{path.name}: {node.name}"
            for node in tree.body
            if isinstance(node, ast.FunctionDef)
            and node.name.startswith("test_")
            and not any(_marks(decorator) for decorator in node.decorator_list)
        ]
    assert not bare


# ----------------------------------------------------------------------------------------------
# modules and class names


def _modules() -> dict[str, Path]:
    paths = sorted(PACKAGE.rglob("*.py"))
    parts = {path: path.relative_to(PACKAGE.parent).with_suffix("").parts for path in paths}
    return {
        ".".join(part[:-1] if part[-1] == "__init__" else part): path
        for path, part in parts.items()
    }


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree without what only type checkers read."""
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)):
            yield child
            yield from _statements(child)


def _module_imports(path: Path, modules: Container[str]) -> set[str]:
    """Modules that a file imports anywhere, inside functions too."""
    names: set[str] = set()
    for node in _statements(_tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in modules else node.module for name in inner}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name in modules}


def _circle(edges: dict[str, set[str]]) -> list[str]:
    """Return one circle, or nothing."""
    left_behind: set[str] = set()

    def visit(name: str, trail: list[str]) -> list[str]:
        if name in trail:
            return [*trail[trail.index(name) :], name]
        if name in left_behind:
            return []
        for target in sorted(edges[name]):
            if circle := visit(target, [*trail, name]):
                return circle
        left_behind.add(name)
        return []

    return next((circle for name in edges if (circle := visit(name, []))), [])


def test_no_modules_import_each_other_in_a_circle() -> None:
    modules = _modules()
    edges = {name: _module_imports(path, modules) - {name} for name, path in modules.items()}
    assert not _circle(edges), "move what both need into a module of its own"


def test_a_circle_is_found() -> None:
    assert _circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert _circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_no_public_class_name_stands_twice() -> None:
    places: dict[str, list[str]] = {}
    for module, path in _modules().items():
        for node in _tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(module)
    assert not {name: where for name, where in places.items() if len(where) > 1}


def _imports(path: Path) -> Iterator[tuple[str, str]]:
    """Module and name of each `from fieldlum... import name` in a file."""
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fieldlum"):
            yield from ((node.module or "", alias.name) for alias in node.names)


def _file(module: str) -> Path:
    place = PACKAGE.parent.joinpath(*module.split("."))
    return place / "__init__.py" if place.is_dir() else place.with_suffix(".py")


@cache
def _text(module: str) -> str:
    file = _file(module)
    return file.read_text(encoding="utf-8") if file.is_file() else ""


@pytest.mark.parametrize("folder", ["tests", "bench", "docs", "examples"])
def test_what_is_imported_exists(folder: str) -> None:
    """Names that a rename forgot: most of these files do not run with the contract tests."""
    wanted = {item for path in (PACKAGE.parent / folder).rglob("*.py") for item in _imports(path)}
    missing = [
        f"{module}.{name}"
        for module, name in sorted(wanted)
        if not re.search(rf"\b{name}\b", _text(module)) and not _file(f"{module}.{name}").is_file()
    ]
    assert not missing
