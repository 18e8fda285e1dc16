"""Draw the packages of fieldlum from their imports: docs/pictures/architecture.svg.

    python docs/draw_architecture.py

The table of packages in docs/architecture.md is brought up to date too: a new package gets the
first line of its docstring, which may then be edited in the table.

A row is a rank, as tests/test_contract_imports.py enforces it; an arrow goes from a package to one
that it imports. Arrows that follow from others are left out (transitive reduction): if `cli`
imports `merge` and `merge` imports `images`, no arrow goes from `cli` to `images`.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "fieldlum"
PICTURE = ROOT / "docs" / "pictures" / "architecture.svg"
PAGE = ROOT / "docs" / "architecture.md"
RANKS_FILE = ROOT / "tests" / "test_contract_imports.py"
ROW_NAMES = (
    "errors, records",
    "arithmetic",
    "files, room",
    "devices",
    "stages",
    "learning",
    "front",
)

WIDTH_PX, ROW_PX, BOX_HEIGHT_PX, LEFT_PX = 1180, 104, 30, 130
CHARACTER_PX, PADDING_PX = 7.4, 20  # of 13 px sans-serif text
FILLS = ("#eceff1", "#e3f2fd", "#e0f2f1", "#f1f8e9", "#fffde7", "#fff3e0", "#fce4ec")
SWEEPS = 12  # of the ordering within rows; more changes nothing


@cache
def ranks() -> list[set[str]]:
    """Return the packages of each rank, lowest first, as the contract test states them."""
    for node in ast.parse(RANKS_FILE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "RANKS":
            return list(ast.literal_eval(node.value))
    raise SystemExit(f"{RANKS_FILE}: no RANKS; expected a tuple of sets; restore it")


def ranked(dotted: str) -> str:
    """Return the innermost ranked package around a name of fieldlum; else its first part."""
    known = set[str]().union(*ranks())
    parts = dotted.split(".")
    heads = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((head for head in heads if head in known), parts[0])


@cache
def imports() -> dict[str, set[str]]:
    """Return the packages that each package of fieldlum imports, itself left out."""
    found: dict[str, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ranked(".".join(parts))
        if parts != ("__init__",) and not (
            len(parts) == 2 and parts[1] == "__init__" and name not in set[str]().union(*ranks())
        ):
            found.setdefault(name, set()).update(_imported(path))
    return {name: (targets & found.keys()) - {name} for name, targets in found.items()}


def _imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "fieldlum":
            names |= {
                ranked(f"{node.module}.{a.name}".removeprefix("fieldlum.")) for a in node.names
            }
    return names


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the edges without those that a longer path implies."""

    def reach(name: str) -> set[str]:
        return edges[name].union(*(reach(target) for target in edges[name]))

    return {
        name: {t for t in targets if not any(t in reach(other) for other in targets - {t})}
        for name, targets in edges.items()
    }


def order(rows: list[set[str]], edges: dict[str, set[str]]) -> list[list[str]]:
    """Return each row from left to right, packages near the middle of their neighbours."""
    lines = [sorted(row) for row in rows]
    neighbours = {name: set(targets) for name, targets in edges.items()}
    for name, targets in edges.items():
        for target in targets:
            neighbours[target].add(name)
    for _ in range(SWEEPS):
        at = {name: x for line in lines for name, x in zip(line, _centres(line), strict=True)}
        for line in lines:
            mean = {n: _mean([at[m] for m in neighbours[n]], at[n]) for n in line}
            line.sort(key=lambda n: (round(mean[n], 3), n))
    return lines


def _mean(values: list[float], default: float) -> float:
    return sum(values) / len(values) if values else default


def _box_width(name: str) -> float:
    return CHARACTER_PX * len(name) + PADDING_PX


def _centres(line: list[str]) -> list[float]:
    widths = [_box_width(name) for name in line]
    gap = (WIDTH_PX - LEFT_PX - sum(widths)) / (len(line) + 1)
    x, centres = LEFT_PX + gap, []
    for width in widths:
        centres.append(x + width / 2)
        x += width + gap
    return centres


def draw() -> str:
    """Return the picture as SVG text; equal imports give equal text."""
    rows = ranks()
    edges = reduced(imports())
    missing = edges.keys() - set().union(*rows)
    if missing:
        raise SystemExit(f"{RANKS_FILE}: no rank for {', '.join(sorted(missing))}; add it there")
    lines = order(rows, edges)
    places = {
        name: (x, 30 + ROW_PX * (len(rows) - 1 - rank))
        for rank, line in enumerate(lines)
        for name, x in zip(line, _centres(line), strict=True)
    }
    height = ROW_PX * len(rows)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {height}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="13">',
        f'<rect width="{WIDTH_PX}" height="{height}" fill="#ffffff"/>',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 1 L7 4 L0 7" fill="none" stroke="#607d8b"/>'
        "</marker></defs>",
    ]
    for rank in range(len(rows)):
        top = 30 + ROW_PX * (len(rows) - 1 - rank)
        parts.append(f'<text x="12" y="{top + 14}" fill="#37474f">rank {rank}</text>')
        parts.append(
            f'<text x="12" y="{top + 30}" fill="#78909c" font-size="11">{ROW_NAMES[rank]}</text>'
        )
    parts += [
        _arrow(*places[name], *places[target])
        for name in sorted(edges)
        for target in sorted(edges[name])
    ]
    for rank, line in enumerate(lines):
        parts += [_box(name, *places[name], FILLS[rank]) for name in line]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _box(name: str, x: float, top: float, fill: str) -> str:
    width = _box_width(name)
    return (
        f'<rect x="{x - width / 2:.1f}" y="{top}" width="{width:.1f}" height="{BOX_HEIGHT_PX}" '
        f'rx="5" fill="{fill}" stroke="#546e7a"/>'
        f'<text x="{x:.1f}" y="{top + 20}" text-anchor="middle" fill="#102027">{name}</text>'
    )


def _arrow(x0: float, top0: float, x1: float, top1: float) -> str:
    """Downwards from box to box; within a rank, an arc above the two boxes."""
    if top0 == top1:
        lift = top0 - 14 - abs(x1 - x0) * 0.04
        curve = f"M{x0:.1f} {top0} C{x0:.1f} {lift:.1f} {x1:.1f} {lift:.1f} {x1:.1f} {top1}"
    else:
        start, end = top0 + BOX_HEIGHT_PX, top1
        bend = 0.5 * (end - start)
        curve = (
            f"M{x0:.1f} {start} C{x0:.1f} {start + bend:.1f} {x1:.1f} {end - bend:.1f} "
            f"{x1:.1f} {end}"
        )
    return f'<path d="{curve}" fill="none" stroke="#90a4ae" marker-end="url(#tip)"/>'


ROW = re.compile(r"^\| (\d) \| `([\w.]+)` \| (.*) \|\n", re.MULTILINE)


def page() -> str:
    """Return docs/architecture.md with one row a package, by rank; known rows keep their text."""
    text = PAGE.read_text(encoding="utf-8")
    known = {name: line for _, name, line in ROW.findall(text)}
    at = {name: i for i, name in enumerate(known)}
    rows = [
        f"| {rank} | `{name}` | {known.get(name) or _first_line(name)} |\n"
        for rank, names in enumerate(ranks())
        for name in sorted(names, key=lambda name: (at.get(name, len(at)), name))
    ]
    first = ROW.search(text)
    if first is None:
        raise SystemExit(f"{PAGE}: no table of packages; expected rows like | 0 | `errors` | ... |")
    return text[: first.start()] + "".join(rows) + ROW.sub("", text[first.start() :])


def _first_line(name: str) -> str:
    place = PACKAGE / name.replace(".", "/")
    path = place.with_suffix(".py")
    path = path if path.is_file() else place / "__init__.py"
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(docstring.split("\n\n")[0].split()).rstrip(".")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    PICTURE.write_text(draw(), encoding="utf-8")
    print(PICTURE.relative_to(ROOT))
