"""Progress reaches the innermost function that shows it."""

from pathlib import Path

import pytest

from fieldlum.core.progress import part_of_progress, progress, quiet, shown_by
from fieldlum.core.scheduler import LOCAL, WorkUnit, run_each

pytestmark = pytest.mark.contract


def test_the_innermost_function_shows_the_progress() -> None:
    shown: list[tuple[int, int, str]] = []
    progress(1, 9, "nobody looks")
    with shown_by(lambda *line: shown.append(line)):
        progress(1, 2, "outer")
        with shown_by(quiet):
            progress(5, 9, "hidden")
        for part in (0, 1):
            with part_of_progress(part, 2):
                progress(3, 4, f"part {part}")
    assert shown == [(1, 2, "outer"), (375, 1000, "part 0"), (875, 1000, "part 1")]


def _steps(folder: Path, count: int) -> None:
    for k in range(count):
        progress(k, count, "a step of a unit")


def test_a_unit_of_work_counts_as_one_step(tmp_path: Path) -> None:
    shown: list[tuple[int, int, str]] = []
    with shown_by(lambda *line: shown.append(line)):
        run_each([WorkUnit("a", _steps, tmp_path, 3)], LOCAL, lambda _: None)
    assert shown == [(1, 1, "a")]


def test_parts_of_unequal_steps_count_on_one_scale() -> None:
    """The counter of a training went back with each held-out fold."""
    shown: list[int] = []
    with shown_by(lambda done, _, __: shown.append(done)):
        for part, total in enumerate((4, 100, 7)):
            with part_of_progress(part, 3, "part "):
                for step in range(total + 1):
                    progress(step, total, "")
    assert shown == sorted(shown) and (shown[0], shown[-1]) == (0, 1000)
