"""Print JSON on stdout, notes and progress on stderr; keep long commands running."""

import json
import math
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import click

from fieldlum.core.progress import Progress, shown_by

# Seconds before the first line of progress in a log, and between lines; chosen.
FIRST_LINE_S, LINE_EVERY_S = 2.0, 60.0


def emit_json(answer: Any) -> None:
    """Print exactly one JSON object on one line of stdout, with null for NaN and infinity.

    answer: plain values and arrays, which become lists; other values become text.
    """
    from fieldlum.session.codec import plain_value

    finite = json.loads(json.dumps(answer, default=plain_value), parse_constant=lambda _: None)
    text = json.dumps(finite, ensure_ascii=False)
    click.echo("".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text))


def print_answer(as_json: bool, answer: Any, lines: Iterable[str]) -> None:
    """Print the answer of a command on stdout: `answer` as one JSON object, or lines of text.

    as_json: whether to print the JSON object; if not, `lines` are printed.
    """
    if as_json:
        emit_json(answer)
    else:
        for line in lines:
            tell(line)


def table_lines(
    rows: Iterable[Mapping[str, Any]], names: Iterable[str] = (), indent: str = ""
) -> list[str]:
    """Return the lines of an aligned table: numbers to the right, texts to the left, "-" for None.

    rows: values by the name of their column. names: of the columns to show; empty for those of the
    first row. A column without any value is omitted. indent: text before each line.
    """
    table = [dict(row) for row in rows]
    names = names or (table[0] if table else ())
    columns = []
    for name in names:
        values = [row.get(name) for row in table]
        if any(value is not None for value in values):
            spec = _spec([abs(value) for value in values if isinstance(value, float)])
            cells = [name, *(_cell(value, spec) for value in values)]
            alignment = "<" if any(isinstance(value, str) for value in values) else ">"
            columns.append([f"{cell:{alignment}{max(map(len, cells))}}" for cell in cells])
    return [indent + "  ".join(line).rstrip() for line in zip(*columns, strict=True)]


def _spec(sizes: list[float]) -> str:
    """Return the format of a column's numbers, such as ".2f"; sizes: their absolute values.

    All numbers have equal decimals, which follow from the largest finite one. If the smallest would
    keep only one digit, each number has three significant digits instead.
    """
    finite = [size for size in sizes if 0.0 < size < math.inf]
    if not finite:
        return ".1f"
    decimals = sum(max(finite) < limit for limit in (1000.0, 10.0, 1.0))
    return f".{decimals}f" if min(finite) >= 10.0 ** (1 - decimals) else "#.3g"


def _cell(value: Any, spec: str) -> str:
    """Return a value as the text of a table's cell; spec: format of floats."""
    if isinstance(value, float):
        return f"{value:{spec}}"
    return "-" if value is None else str(value)


def printable(text: str) -> str:
    """Return a text with "?" for control codes, which could change what a terminal shows.

    A file name or a file of another person may contain them.
    """
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def say(text: str) -> None:
    """Print a sentence, `text`, for the user on stderr."""
    click.echo(printable(text), err=True)


def tell(text: str) -> None:
    """Print a line, `text`, of a command's answer on stdout."""
    click.echo(printable(text))


def notes(texts: Iterable[str]) -> None:
    """Print sentences for the user on stderr, each after the word note."""
    for text in texts:
        say(f"note: {text}")


def is_terminal() -> bool:
    """Return whether stderr is a terminal, where a user may see its output."""
    return sys.stderr.isatty()


@contextmanager
def unattended() -> Iterator[None]:
    """Let a command that runs for weeks survive a closed terminal, in a `with` block.

    The command and the processes that it starts ignore SIGHUP. SIGTERM ends the command like
    Ctrl-C. Call it in the main thread.
    """
    wanted: dict[signal.Signals, Any] = {signal.SIGTERM: signal.default_int_handler}
    if hasattr(signal, "SIGHUP"):  # not on Windows
        wanted[signal.SIGHUP] = signal.SIG_IGN
    before = {number: signal.signal(number, how) for number, how in wanted.items()}
    try:
        yield
    finally:
        for number, how in before.items():
            signal.signal(number, how)


@contextmanager
def awake() -> Iterator[None]:
    """Keep the computer awake in a `with` block; print a note if that is not possible."""
    from fieldlum.devices.awake import kept_awake

    with kept_awake() as locks:
        if not locks:
            say("note: cannot keep the computer awake: run fieldlum doctor for the reason")
        yield


def _progress_lines(label: str) -> Progress:
    """Return a function that prints progress in a pipe or a log.

    It prints a line on stderr after 2 s, then one per minute; label: at the start of each line.
    """
    started, due_s = time.monotonic(), FIRST_LINE_S
    before = -1.0
    repeats = False  # work of several parts, such as a model after another, whose count is unknown
    # number of steps finished first, and when [s]: the start-up before them is not repeated
    first: tuple[int, float] | None = None

    def show(finished: int, total: int, text: str) -> None:
        """Print a line when it is due, with the remaining time unless work began again.

        The arguments are those of `Progress`.
        """
        nonlocal due_s, before, repeats, first
        spent_s, share = time.monotonic() - started, finished / max(total, 1)
        repeats, before = repeats or share < before, share
        if finished > 0 and first is None:
            first = (finished, spent_s)
        if spent_s < due_s or total <= 0:
            return
        due_s = spent_s + LINE_EVERY_S
        more = f" ({text})" if text else ""
        if first is not None and finished > first[0] and not repeats:
            each_s = (spent_s - first[1]) / (finished - first[0])
            more = f", about {each_s * (total - finished) / 60:.1f} min left"
        say(f"{label}: {finished} of {total}{more}")

    return show


@contextmanager
def progress(label: str) -> Iterator[Progress]:
    """Show the progress of work in a `with` block: a bar with the remaining time on a terminal.

    In a pipe or a log, print a line after 2 s and then one per minute on stderr. Yield the function
    that shows the progress. label: name of the work.
    """
    if not is_terminal():
        lines = _progress_lines(label)
        with shown_by(lines):
            yield lines
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        *rich_progress.Progress.get_default_columns(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TextColumn("{task.fields[text]}", markup=False),
    )
    with rich_progress.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None, text="")

        def show(finished: int, total: int, text: str) -> None:
            """Move the bar; the arguments are those of `Progress`, and a total of 0 is unknown."""
            bar.update(task, completed=finished, total=total or None, text=printable(text))

        with shown_by(show):
            yield show
