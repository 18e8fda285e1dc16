"""Units of work: the option's text, lost and hanging processes, and what tasks hold."""

import multiprocessing
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import scheduler_units as units
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.errors import Caution, InputError
from fieldlum.core.progress import shown_by
from fieldlum.core.scheduler import (
    LOCAL,
    SHARED_VARIABLE,
    Scheduler,
    UnitOutcome,
    WorkUnit,
    parse_scheduler,
    perform,
    run_each,
    task_of,
)

pytestmark = pytest.mark.contract


def troubled(folder: Path, name: str, how: str, times: int) -> WorkUnit:
    return WorkUnit(name, units.troubled, folder, {"name": name, "how": how, "times": times})


# ----------------------------------------------------------------------------------------------
# the option


def test_the_text_of_the_option_names_a_scheduler() -> None:
    assert parse_scheduler("local") == LOCAL == Scheduler(1)
    assert parse_scheduler("processes:3") == Scheduler(3)
    assert parse_scheduler("tcp://127.0.0.1:8786").address == "tcp://127.0.0.1:8786"
    assert parse_scheduler("tls://10.0.0.7:8786").address == "tls://10.0.0.7:8786"
    with pytest.warns(Caution, match="anyone who can reach that port can run programs"):
        parse_scheduler("tcp://10.0.0.7:8786")


@pytest.mark.parametrize(
    "text", ["", "threads", "processes:0", "processes:x", "tcp://", "tcp://host", "tls://u@a:1"]
)
def test_any_other_text_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--scheduler"):
        parse_scheduler(text)


@pytest.mark.parametrize("text", ["{}", "[]", "no json", '{"address": 5}', '{"address": "a:1"}'])
def test_a_file_of_a_scheduler_names_its_address(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cluster.json"
    path.write_text('{"type": "Scheduler", "address": "tcp://127.0.0.1:1"}')
    assert parse_scheduler(str(path)).address == "tcp://127.0.0.1:1"
    path.write_text(text)
    with pytest.raises(InputError):
        parse_scheduler(str(path))


def test_without_dask_one_line_states_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same answer for each package of an extra."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    some = [WorkUnit("a", units.doubled, tmp_path, 1)]
    scheduler = parse_scheduler("tcp://127.0.0.1:8786")
    monkeypatch.setattr(
        "fieldlum.session.open_session", lambda _: units.outcomes_of(some, scheduler)
    )
    result = CliRunner().invoke(main, ["status", str(tmp_path)])
    assert result.exit_code == 3 and "pip install '.[cluster]'" in result.stderr


@pytest.mark.parametrize("error", [OSError, TimeoutError, ValueError, MemoryError])
def test_another_program_at_the_address_is_no_scheduler(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """An answer without Dask's length in front was reported as data of 3 EiB."""

    def client(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("distributed.Client", client)
    some = [WorkUnit("a", units.doubled, tmp_path, 1)]
    with pytest.raises(InputError, match="no scheduler answers"):
        units.outcomes_of(some, parse_scheduler("tcp://127.0.0.1:8786"))


def test_a_number_of_workers_is_a_number_of_processes(tmp_path: Path) -> None:
    assert parse_scheduler("2") == parse_scheduler("processes:2")
    result = CliRunner().invoke(main, ["merge", str(tmp_path), "--scheduler", "2"])
    assert result.exit_code == 3, "the option is known; the folder is no session"


# ----------------------------------------------------------------------------------------------
# this computer


def test_each_process_has_one_thread(tmp_path: Path) -> None:
    """Else n processes on n cores start n threads each, which wait for each other."""
    some = [WorkUnit(str(k), units.thread_counts, tmp_path, None) for k in range(2)]
    found = [outcome.result() for outcome in units.outcomes_of(some, Scheduler(2))]
    assert found == [{1}, {1}]


def test_units_run_here_in_order(tmp_path: Path) -> None:
    some = [WorkUnit(f"u{k}", units.doubled, tmp_path, k) for k in range(3)]
    shown: list[tuple[int, int, str]] = []
    with shown_by(lambda *line: shown.append(line)):
        outcomes = units.outcomes_of(some, LOCAL)
    assert [o.result() for o in outcomes] == [0, 2, 4]
    assert shown == [(1, 3, "u0"), (2, 3, "u1"), (3, 3, "u2")]
    assert units.outcomes_of([], LOCAL) == []


def test_an_error_of_a_unit_is_its_own(tmp_path: Path) -> None:
    some = [troubled(tmp_path, "bad", "defect", 9), WorkUnit("a", units.doubled, tmp_path, 1)]
    bad, good = units.outcomes_of(some, LOCAL)
    assert good.result() == 2 and len(list(tmp_path.glob("bad.try*"))) == 1
    with pytest.raises(ValueError, match="a defect"):
        bad.result()


@pytest.mark.slow
def test_a_lost_process_costs_its_unit_alone(tmp_path: Path) -> None:
    """Killed and full: each is tried again, and one that never ends well is named."""
    some = [
        troubled(tmp_path, "killed", "kill", 1),
        troubled(tmp_path, "full", "full", 1),
        troubled(tmp_path, "poison", "kill", 9),
        *(WorkUnit(f"u{k}", units.doubled, tmp_path, k) for k in range(4)),
    ]
    outcomes = {o.unit.name: o for o in units.outcomes_of(some, Scheduler(2))}
    assert len(outcomes) == len(some)
    assert [outcomes[f"u{k}"].result() for k in range(4)] == [0, 2, 4, 6]
    assert [outcomes[name].result() for name in ("killed", "full")] == ["killed", "full"]
    tried = "unit of work poison: given up after 4 tries, the last: its process was killed"
    with pytest.raises(InputError, match=tried):
        outcomes["poison"].result()


# ----------------------------------------------------------------------------------------------
# what goes over the wire


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(SHARED_VARIABLE, str(tmp_path))
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "input.txt").write_text("light")
    return tmp_path / "room"


def test_a_task_holds_no_absolute_path(shared: Path) -> None:
    task = task_of(WorkUnit("a", units.doubled, shared, 3, files=("input.txt",)))
    assert str(shared.parent).encode() not in pickle.dumps(task)
    assert perform(task) == (6, "")
    with pytest.raises(InputError, match=f"set {SHARED_VARIABLE}"):
        task_of(WorkUnit("a", units.doubled, shared.parents[1], 3))


def test_a_stale_file_is_noticed(shared: Path) -> None:
    task = task_of(WorkUnit("a", units.doubled, shared, 3, files=("input.txt", "gone.txt")))
    assert perform(task) == (6, "")
    (shared / "input.txt").write_text("dark")
    value, trouble = perform(task)
    assert value is None and "its input.txt differs" in trouble


def test_a_full_disk_is_the_worker_s_trouble(shared: Path) -> None:
    task = task_of(troubled(shared, "full", "full", 1))
    assert perform(task) == (None, "No space left on device")


@pytest.mark.parametrize("name", ["fieldlum", "source", "profiles", "numpy"])
def test_another_version_is_refused(shared: Path, name: str) -> None:
    task = task_of(WorkUnit("a", units.doubled, shared, 3))
    assert task.software[name] != "none"
    value, trouble = perform(replace(task, software=task.software | {name: "9.9"}))
    assert value is None
    assert f"rejected: {name} {task.software[name]} (here 9.9)" in trouble


@pytest.mark.slow
def test_an_error_of_the_caller_ends_the_crew(tmp_path: Path) -> None:
    """Else the command would wait at its end for workers that nobody needs any more."""
    some = [WorkUnit(f"u{k}", units.doubled, tmp_path, k) for k in range(4)]
    given: list[int] = []

    def take(outcome: UnitOutcome) -> None:
        given.append(outcome.result())
        raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        run_each(some, Scheduler(2), take)
    assert len(given) == 1 and not multiprocessing.active_children()
