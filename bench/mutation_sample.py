"""Would the tests notice a fault? A seeded sample of small changes to modules that promise much.

    python bench/mutation_sample.py [--mutants 200] [--seed 1] [--minutes 60] [--first 0] [--part P]
        [--fast]

Each mutant has one change: a comparison, an arithmetic sign, a number, a truth value, a negated
condition, `and` for `or`, or a statement without effect in place of a call. The tests named in
`PARTS` run against it in a copy of the package, in a process forked from one that has imported the
libraries: those marked slow only if the others pass. A failure or a time-out means that the mutant
is caught. Prints a table by part, then
each survivor with its change, to be read and judged. mutmut and cosmic-ray are not used: both run
one set of tests for all modules, and start Python anew for each mutant.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PARTS = {  # modules of a part, and the tests that should notice a fault in them, fast ones first
    "session": (
        ("core/files.py", "session/*.py", "session/files/*.py"),
        "test_flushed test_digests test_session_files test_session test_capture_disk "
        "test_hostile_models test_frame_changes test_foreign_session test_pair test_new",
    ),
    "merge/estimator": (
        ("merge/estimator.py",),
        "test_merge_motion test_merge test_merge_budget",
    ),
    "glare/metrics": (
        ("year/glare/metrics.py",),
        "test_glare test_disc_doubt test_unseen test_glare_single test_glare_own_pixels",
    ),
    "irradiance": (("pair/irradiance/*.py",), "test_irradiance test_irradiance_consistency"),
    "web/server": (("web/server.py",), "test_watch test_scene_click"),
}
CPU_S, WALL_S = 240, 3600.0  # more than any part's tests need; the second is for a dead lock
_OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.And: ast.Or, ast.Or: ast.And, ast.USub: ast.UAdd, ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr, ast.Mod: ast.Mult, ast.FloorDiv: ast.Div,
}  # fmt: skip


class Mutant(NamedTuple):
    part: str
    path: Path  # relative to the root
    line: int
    before: str
    after: str
    source: str


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield nodes to put in the place of one node."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _OPPOSITE:
        ops = [_OPPOSITE[type(node.ops[0])](), *node.ops[1:]]
        yield ast.Compare(node.left, ops, node.comparators)  # type: ignore[arg-type]
    elif isinstance(node, ast.BinOp) and type(node.op) in _OPPOSITE:
        yield ast.BinOp(node.left, _OPPOSITE[type(node.op)](), node.right)  # type: ignore[arg-type]
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(_OPPOSITE[type(node.op)](), node.values)  # type: ignore[arg-type]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield ast.Constant(node.value * 2 if node.value not in (0, 0.0) else node.value + 1)
    elif isinstance(node, ast.If | ast.IfExp):
        kind = type(node)
        rest = {name: value for name, value in ast.iter_fields(node) if name != "test"}
        yield kind(test=ast.UnaryOp(ast.Not(), node.test), **rest)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield ast.Pass()


def _is_code(node: ast.AST, parents: dict[ast.AST, ast.AST]) -> bool:
    """Return whether a node is evaluated when the program runs: no annotation, no type test."""
    child = node
    while (parent := parents.get(child)) is not None:
        if isinstance(parent, ast.arg) or (
            isinstance(parent, ast.AnnAssign) and child is parent.annotation
        ):
            return False
        if isinstance(parent, ast.FunctionDef) and child is parent.returns:
            return False
        if isinstance(parent, ast.If) and "TYPE_CHECKING" in ast.unparse(parent.test):
            return False
        child = parent
    return True


def modules_of(part: str) -> list[Path]:
    """Return the modules of a part; each of its patterns names some, else ValueError is raised."""
    found = {text: sorted((ROOT / "fieldlum").glob(text)) for text in PARTS[part][0]}
    if empty := [text for text, paths in found.items() if not paths]:
        raise ValueError(f"{part}: no module {', '.join(empty)}")
    return [path for paths in found.values() for path in paths]


def tests_of(part: str) -> list[str]:
    """Return the paths of a part's tests, relative to the root."""
    return [f"tests/{name}.py" for name in PARTS[part][1].split()]


def mutants() -> list[Mutant]:
    """Return every mutant of all parts, in the order of the files."""
    found: list[Mutant] = []
    for part in PARTS:
        for path in modules_of(part):
            text = path.read_text(encoding="utf-8")
            tree = ast.parse(text)
            parents = {c: node for node in ast.walk(tree) for c in ast.iter_child_nodes(node)}
            for node in ast.walk(tree):
                for other in _changes(node) if _is_code(node, parents) else ():
                    segment = ast.get_source_segment(text, node) or ""
                    replaced = _replaced(text, node, other)
                    found.append(
                        Mutant(
                            part,
                            path.relative_to(ROOT),
                            node.lineno,  # type: ignore[attr-defined]
                            segment.splitlines()[0],
                            ast.unparse(ast.fix_missing_locations(other)).splitlines()[0],
                            replaced,
                        )
                    )
    return found


def _replaced(text: str, node: ast.AST, other: ast.AST) -> str:
    """Return the source with one node in place of another; the other lines are unchanged."""
    lines = text.splitlines(keepends=True)
    first, last = node.lineno - 1, node.end_lineno - 1  # type: ignore[attr-defined]
    head = lines[first].encode()[: node.col_offset].decode()  # type: ignore[attr-defined]
    tail = lines[last].encode()[node.end_col_offset :].decode()  # type: ignore[attr-defined]
    new = ast.unparse(ast.fix_missing_locations(other))
    indented = new.replace("\n", "\n" + " " * len(head))
    new = f"({new})" if isinstance(other, ast.expr) else indented
    return "".join(lines[:first]) + head + new + tail + "".join(lines[last + 1 :])


def caught(copy: Path, part: str, *, fast: bool) -> bool:
    """Return whether a test of the part fails, or hangs, in the copy of the package.

    fast: without the tests marked slow.
    """
    child = os.fork()
    if child == 0:
        os.setsid()
        output = os.open(copy.parent / "output.txt", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (1, 2):
            os.dup2(output, number)
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        sys.path[:0] = [str(copy), str(copy / "tests")]
        import pytest

        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        code = 1
        try:
            for marks in ("not slow", "slow")[: 1 if fast else 2]:
                options = ["-x", "-q", "-p", "no:cacheprovider", "-m", marks]
                code = int(pytest.main([*options, *tests_of(part)]))
                code = 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code
                if code:
                    break
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    end = time.monotonic() + WALL_S
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status) != 0
        time.sleep(0.1)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="place in the sample to begin at")
    parser.add_argument("--minutes", type=float, default=600.0)
    parser.add_argument("--part", choices=PARTS, action="append", help="only this part")
    parser.add_argument("--fast", action="store_true", help="leave out tests marked slow")
    asked = parser.parse_args()
    for name in ("cv2", "pandas", "pvlib", "pytest", "scipy.stats", "starlette"):
        importlib.import_module(name)  # once for all forked processes
    every = mutants()
    # The parts get equal shares: session has most of the lines.
    rng, sample = random.Random(asked.seed), []
    for part in PARTS:
        of = [m for m in every if m.part == part]
        sample += rng.sample(of, min(len(of), asked.mutants // len(PARTS)))
    rng.shuffle(sample)
    sample = [m for m in sample if m.part in (asked.part or PARTS)]
    counts: Counter[tuple[str, bool]] = Counter()
    survivors: list[Mutant] = []
    end = time.monotonic() + 60 * asked.minutes
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", "_build", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)
        for part in asked.part or PARTS:
            if caught(copy, part, fast=asked.fast):
                print((copy.parent / "output.txt").read_text("utf-8", "replace")[-4000:])
                sys.exit(f"the tests of {part} fail without a change")
        print(f"{len(every)} mutants, sample of {len(sample)}", file=sys.stderr, flush=True)
        for number, mutant in enumerate(sample[asked.first :], start=asked.first):
            if time.monotonic() > end:
                print(f"ended before mutant {number} of the sample", file=sys.stderr)
                break
            place = copy / mutant.path
            whole = place.read_text(encoding="utf-8")
            place.write_text(mutant.source, encoding="utf-8")
            noticed = caught(copy, mutant.part, fast=asked.fast)
            place.write_text(whole, encoding="utf-8")
            counts[mutant.part, noticed] += 1
            if not noticed:
                survivors.append(mutant)
            word = "caught" if noticed else "SURVIVED"
            text = f"{mutant.path}:{mutant.line} `{mutant.before}` -> `{mutant.after}`"
            print(f"{number} {word} {text}", file=sys.stderr, flush=True)
    print("| part | mutants | tried | caught |\n|---|---|---|---|")
    for part in PARTS:
        yes, no = counts[part, True], counts[part, False]
        print(f"| {part} | {sum(m.part == part for m in every)} | {yes + no} | {yes} |")
    print(f"| all | {len(every)} | {counts.total()} | {counts.total() - len(survivors)} |")
    print("\n| survivor | change |\n|---|---|")
    for m in sorted(survivors):
        print(f"| {m.path.relative_to('fieldlum')}:{m.line} | `{m.before}` → `{m.after}` |")


if __name__ == "__main__":
    main()
