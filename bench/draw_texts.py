"""Draw texts of the package at random, for a reader who sees nothing but the text.

    python bench/draw_texts.py SEED OUT

writes OUT/texts.md: 30 public docstrings with their signatures (D), 30 error texts (E), and 10
verdicts or warnings with the condition that prints them (V); and OUT/places.md: where each is. A
reader paraphrases texts.md without the code; a judge writes what the code does, from places.md,
before reading the paraphrases.
"""

from __future__ import annotations

import ast
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "fieldlum"
ERRORS = {"InputError", "DeviceError", "NotEnoughDataError"}
VERDICT_MODULES = (
    "merge/bracket",
    "merge/stage",
    "learn/train/",
    "room/fit/stage",
    "room/fit/fit",
    "year/glare/",
    "year/predict/year",
    "pair/irradiance",
    "capture/doctor",
    "capture/frame_checks",
    "plan/__init__",
    "calibrate/",
)
LEAST_WORDS = 12  # of a verdict: shorter strings are labels or parts


@dataclass(frozen=True)
class Text:
    """A text as its reader sees it, and its place in the package."""

    shown: str
    place: str


def constants(tree: ast.Module) -> dict[str, str]:
    """Return the texts that a module names."""
    found = {}
    for node in tree.body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=str(text))):
                found[name] = text
            case _:
                pass
    return found


def expression(node: ast.expr) -> str:
    """Return a string expression with its values in braces."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        parts = [
            "{" + ast.unparse(part.value) + "}"
            if isinstance(part, ast.FormattedValue)
            else expression(part)
            for part in node.values
        ]
        return "".join(parts)
    return "{" + ast.unparse(node) + "}"


def signature(node: ast.AST) -> str:
    """Return a function's head, or a class with its annotated fields."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
        return f"def {node.name}({ast.unparse(node.args)}){result}"
    assert isinstance(node, ast.ClassDef)
    fields = [ast.unparse(f) for f in node.body if isinstance(f, ast.AnnAssign)]
    bases = ", ".join(ast.unparse(base) for base in node.bases)
    return "\n    ".join([f"class {node.name}({bases}):", *fields])


def docstrings(tree: ast.Module, path: str) -> Iterator[Text]:
    """Yield public functions, methods and classes that have a docstring."""
    holders: list[tuple[ast.AST, str]] = [(tree, "")]
    while holders:
        holder, prefix = holders.pop()
        for node in getattr(holder, "body", []):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            if node.name.startswith("_"):
                continue
            if isinstance(node, ast.ClassDef):
                holders.append((node, f"{node.name}."))
            if text := ast.get_docstring(node):
                head = f"{path}: {prefix}{node.name}\n{signature(node)}"
                yield Text(f"{head}\n\n{text}", f"fieldlum/{path}.py:{node.lineno}")


def errors(tree: ast.Module, path: str) -> Iterator[Text]:
    """Yield error texts in the form in which they are printed."""
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
            continue
        if node.func.id not in ERRORS or not node.args:
            continue
        names = ("source", "found", "expected", "remedy")
        parts = dict(zip(names, map(expression, node.args), strict=False))
        parts |= {k.arg: expression(k.value) for k in node.keywords if k.arg}
        if node.func.id == "InputError":
            expected = f"; expected {parts['expected']}" if parts.get("expected") else ""
            remedy = f"; {parts['remedy']}" if parts.get("remedy") else ""
            shown = f"{parts['source']}: {parts.get('found', '')}{expected}{remedy}"
        else:
            shown = expression(node.args[0])
        for name, value in constants(tree).items():
            shown = shown.replace("{" + name + "}", value)
        yield Text(f"{node.func.id}: {shown}", f"fieldlum/{path}.py:{node.lineno}")


def verdicts(tree: ast.Module, path: str) -> Iterator[Text]:
    """Yield statements that build a verdict or a warning, with the condition around them."""
    if not path.startswith(VERDICT_MODULES):
        return
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    statements: dict[ast.stmt, int] = {}
    for node in ast.walk(tree):
        if not isinstance(node, ast.JoinedStr | ast.Constant):
            continue
        if isinstance(parents[node], ast.JoinedStr | ast.FormattedValue):
            continue
        words = len(expression(node).split()) if isinstance(getattr(node, "value", ""), str) else 0
        holder: ast.AST = node
        while not isinstance(holder, ast.stmt):
            holder = parents[holder]
        if words >= LEAST_WORDS and not isinstance(holder, ast.Raise):
            statements[holder] = max(words, statements.get(holder, 0))
    for statement in statements:
        first = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        if first or isinstance(statement, ast.FunctionDef | ast.ClassDef):
            continue  # a docstring, a decorator's help
        above = parents[statement]
        shown = ast.unparse(statement)
        if isinstance(above, ast.If):
            shown = f"if {ast.unparse(above.test)}:\n    {shown}"
        yield Text(shown, f"fieldlum/{path}.py:{statement.lineno}")


def main() -> None:
    seed, out = int(sys.argv[1]), Path(sys.argv[2])
    rng = random.Random(seed)
    trees = {
        str(p.relative_to(PACKAGE).with_suffix("")): ast.parse(p.read_text(encoding="utf-8"))
        for p in sorted(PACKAGE.rglob("*.py"))
    }
    out.mkdir(parents=True, exist_ok=True)
    texts, places = [], []
    for letter, pool, count in (("D", docstrings, 30), ("E", errors, 30), ("V", verdicts, 10)):
        every = [text for path, tree in trees.items() for text in pool(tree, path)]
        print(f"{letter}: {count} of {len(every)}")
        for number, text in enumerate(rng.sample(every, count), start=1):
            texts.append(f"## {letter}{number}\n\n```text\n{text.shown}\n```\n")
            places.append(f"{letter}{number} {text.place}")
    (out / "texts.md").write_text("\n".join(texts), encoding="utf-8")
    (out / "places.md").write_text("\n".join(places) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
