"""Report the progress of long work; the caller of the work decides whether it is shown."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[int, int, str], None]
"""Shows progress: called with the number of finished steps, of all steps, and a text."""


def quiet(finished: int, total: int, text: str) -> None:
    """Show nothing: a `Progress` for work whose progress is not to be seen."""


_SHOW: ContextVar[Progress] = ContextVar("show", default=quiet)


def progress(finished: int, total: int, text: str) -> None:
    """Report the progress of work that takes over two seconds; the innermost `shown_by` shows it.

    finished, total: number of finished and of all steps; text: name of the work or of its step,
    such as "pictures".
    """
    _SHOW.get()(finished, total, text)


@contextmanager
def shown_by(show: Progress) -> Iterator[None]:
    """Let `show` show the progress that this thread reports in a `with` block.

    `quiet` shows nothing.
    """
    token = _SHOW.set(show)
    try:
        yield
    finally:
        _SHOW.reset(token)


@contextmanager
def part_of_progress(number: int, count: int, what: str = "") -> Iterator[None]:
    """Let a `with` block's progress count as that of part `number` (from 0) of `count` equal parts.

    The progress of all parts together then has one scale, of 1000 steps. what: text before that of
    the part.
    """
    show = _SHOW.get()

    def show_part(finished: int, total: int, text: str) -> None:
        """Show the progress of the part as that of all parts; the arguments are of `Progress`."""
        show(round(1000 * (number + finished / max(total, 1)) / count), 1000, what + text)

    with shown_by(show_part):
        yield
