"""Report how far long work is; who called the work decides whether somebody sees it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[int, int, str], None]
"""Shows how far work is: called with the number of finished steps, of all steps, and a text."""


def quiet(finished: int, total: int, text: str) -> None:
    """Show nothing; the arguments are those of `progress`."""


_SHOW: ContextVar[Progress] = ContextVar("show", default=quiet)


def progress(finished: int, total: int, text: str) -> None:
    """Report how far work is that takes over two seconds, to the innermost `shown_by`.

    finished, total: number of finished and of all steps; text: what is done, such as "pictures".
    """
    _SHOW.get()(finished, total, text)


@contextmanager
def shown_by(show: Progress) -> Iterator[None]:
    """Show the progress of work in a `with` block by `show`; with `quiet` it is not shown."""
    token = _SHOW.set(show)
    try:
        yield
    finally:
        _SHOW.reset(token)


@contextmanager
def part_of_progress(number: int, count: int) -> Iterator[None]:
    """Show the progress in a `with` block as that of part `number` of `count` equal parts.

    number: from 0.
    """
    show = _SHOW.get()
    with shown_by(lambda done, total, text: show(number * total + done, count * total, text)):
        yield
