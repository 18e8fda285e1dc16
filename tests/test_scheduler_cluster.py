"""A real Dask scheduler and its workers over TCP: the files of one process, none twice."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import scheduler_units as units
from dask_cluster import SOURCE, Cluster, cluster
from test_merge_stage import START, profile, take

from fieldlum import merge
from fieldlum.profiles import save_profile
from fieldlum.records import CameraSetup, Exposure, Site, SiteFile, Slot
from fieldlum.scheduler import SHARED_VARIABLE, Scheduler, WorkUnit, parse_scheduler, run_units
from fieldlum.session import Session, create_session, remove_scraps

pytestmark = [pytest.mark.contract, pytest.mark.slow]


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory):
    root = tmp_path_factory.mktemp("cluster")
    other = root / "other-version"
    shutil.copytree(SOURCE / "fieldlum", other / "fieldlum")
    with (other / "fieldlum" / "version.py").open("a") as file:
        file.write("# another\n")
    with cluster(root, root / "shared", "first", "second") as made:
        made.worker("stranger", source=other)
        (root / "shared" / "out").mkdir(parents=True)
        yield made


@pytest.fixture
def scheduler(running: Cluster, monkeypatch: pytest.MonkeyPatch) -> Scheduler:
    monkeypatch.setenv(SHARED_VARIABLE, str(running.shared))
    return parse_scheduler(str(running.file))


def session_of(root: Path, profile_path: Path) -> Session:
    setup = SiteFile(Site("here", 51.5, 0.0), CameraSetup(str(profile_path), 180.0))
    return create_session(root, setup, [Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))], {})


def files(session: Session) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in session.panoramas.iterdir()}


def test_workers_write_the_files_of_one_process(running: Cluster, scheduler: Scheduler) -> None:
    """Three brackets, one of them with a frame that nobody can read."""
    path = running.shared.parent / "small.toml"
    save_profile(path, profile())
    session = session_of(running.shared / "room", path)
    slots = [take(session, number) for number in range(3)]
    (session.raw / slots[2] / "1.dng").write_bytes(b"no raw")
    alone = merge.run(session, height=16)
    expected = files(session)
    assert len(expected) >= 8
    assert merge.run(session, height=16, force=True, scheduler=scheduler) == alone
    assert files(session) == expected
    kept = merge.run(session, height=16, scheduler=scheduler)
    assert [v.state for v in kept] == ["kept", "kept", "merged"], "a lost frame may come back"


def test_killed_hanging_full_and_other_workers_cost_their_units_alone(
    running: Cluster, scheduler: Scheduler
) -> None:
    """Twenty units write a file each; one worker is killed and one unit hangs in its worker."""
    notes: list[str] = []
    names = [f"n{k}.txt" for k in range(20)]
    folder = running.shared
    some = [
        WorkUnit(
            name, units.written, folder, {"name": name, "seconds": 0.2}, outputs=(f"out/{name}",)
        )
        for name in names
    ]
    some += [
        WorkUnit(how, units.troubled, folder, {"name": how, "how": how, "times": 1})
        for how in ("hang", "full")
    ]
    running.worker("third")
    running.worker("fourth")
    limited = replace(scheduler, unit_limit_s=12.0, say=notes.append)
    outcomes = []
    for outcome in run_units(some, limited):
        outcomes.append(outcome)
        if len(outcomes) == 4:
            running.signal("first")
    assert sorted(o.unit.name for o in outcomes) == sorted([*names, "hang", "full"]), "none twice"
    assert not [o.trouble for o in outcomes if o.trouble or o.error]
    remove_scraps(folder / "out")  # of the killed worker
    assert sorted(path.name for path in (folder / "out").iterdir()) == sorted(names)
    text = "\n".join(notes)
    assert "refused: source" in text and "install there what is installed here" in text
    assert "No space left on device; it gets no further units" in text
    assert "it hangs; it gets no further units" in text
