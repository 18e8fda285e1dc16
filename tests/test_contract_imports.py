"""A module imports from ranks above it, or acyclically within its own; stages never import each
other. Every test has a kind.
"""

import ast
from collections.abc import Container, Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.contract

PACKAGE = Path(__file__).parents[1] / "fieldlum"
RANKS = (
    {"arrays", "errors", "records", "model_registry", "room_states", "version"},
    {
        "compiled",
        "photometry",
        "plot_style",
        "projection",
        "rowwise",
        "statistics",
        "strict_csv",
        "strict_toml",
        "sun",
        "sun_disc",
        "sun_images",
        "sky",
        "light",
        "light_clock",
    },
    {"images", "linear_light", "raw", "profiles", "site_toml", "session", "scene", "weather"},
    {"devices", "notify", "scheduler", "sky_view"},
    {"plan", "doctor", "capture", "calibrate", "merge", "irradiance", "pair", "glare", "simulate"},
    {"models", "train", "predict", "bench", "scene_fit"},
    {"campaign", "report", "demo", "cli", "api", "view", "web"},
)
RANK = {module: rank for rank, modules in enumerate(RANKS) for module in modules}
STAGES = 4


def _module(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def _imported(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "fieldlum":
            parts = (node.module or "").split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("fieldlum.")}
    return {name for name in found if not name.startswith("__")}


FILES = sorted(p for p in PACKAGE.rglob("*.py") if _module(p) != "__init__")


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
