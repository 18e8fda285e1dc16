"""A real Dask scheduler and its workers over TCP: the files of one process, none twice."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import scheduler_units as units
from dask_cluster import SOURCE, Cluster, cluster
from test_frame_changes import one_bit, recorded
from test_merge_stage import START, profile, take

from fieldlum import merge
from fieldlum.core.errors import Caution, InputError
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot
from fieldlum.core.scheduler import (
    LOCAL,
    SHARED_VARIABLE,
    Scheduler,
    UnitOutcome,
    WorkUnit,
    parse_scheduler,
    run_each,
    software,
)
from fieldlum.learn import models
from fieldlum.learn.models.training_data import load_pairs
from fieldlum.optics.profiles import save_profile, shipped
from fieldlum.pair import BracketInterval, write_patches
from fieldlum.room import simulate
from fieldlum.session import Session, create_session
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.site_toml import load_site
from fieldlum.sky.daylight import light_at
from fieldlum.year import predict

pytestmark = [
    pytest.mark.contract,
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::fieldlum.core.errors.Caution"),  # one worker is a stranger
]


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
    """Four brackets: one with a frame that nobody can read, one with a frame that changed."""
    path = running.shared.parent / "small.toml"
    save_profile(path, profile())
    session = session_of(running.shared / "room", path)
    slots = [take(session, number) for number in range(3)]
    (session.raw / slots[2] / "1.dng").write_bytes(b"no raw")
    one_bit(recorded(session, 3) / "1.dng")
    alone = merge.run(session, merge.MergeOptions(height=16))
    assert alone[3].state == "failed" and "1.dng changed" in alone[3].text
    expected = files(session)
    assert len(expected) >= 8
    assert (
        merge.run(session, merge.MergeOptions(height=16), force=True, scheduler=scheduler) == alone
    )
    assert files(session) == expected
    kept = merge.run(session, merge.MergeOptions(height=16), scheduler=scheduler)
    states = [v.state for v in kept]
    assert states == ["kept", "kept", "merged", "failed"], "a lost frame may come back"


def test_a_year_a_room_and_its_patches_are_those_of_one_process(
    running: Cluster, scheduler: Scheduler
) -> None:
    """Simulate, pair's patches and predict with maps: every file has the same bytes."""
    root = running.shared
    alone, spread = (
        simulated_year(root / name, how) for name, how in (("a", LOCAL), ("b", scheduler))
    )
    assert len(alone) > 20
    assert {name for name in alone if alone[name] != spread.get(name)} == set()
    assert alone.keys() == spread.keys()


def simulated_year(root: Path, scheduler: Scheduler) -> dict[str, bytes]:
    """Return the files of a small simulated session with a predicted month."""
    setup = load_site(shipped("capture_plans") / "seattle-office.toml")
    weather = simulate.weather_for(setup)
    slots = simulate.sample_slots(setup, weather, 18, 1)
    session = create_session(root, setup, slots, {"set": "test"})
    simulate.run(session, weather, height=8, quality="draft", scheduler=scheduler)
    rendered = [s for s in slots if session.truth_panorama(s.id).is_file()]
    brackets = [
        BracketInterval(
            s.id,
            session.truth_panorama(s.id),
            CaptureFile(slot=s.id, frames=(), t_open_utc=s.t_utc, t_close_utc=s.t_utc),
        )
        for s in rendered
    ]
    light = light_at([s.t_utc for s in rendered], setup.site, np.array(500.0), np.array(100.0))
    write_patches(session, setup, brackets, light, True, scheduler)
    model = root.parent / "nearest"  # one model for both: its config.json has its time
    if not model.is_dir():
        data = load_pairs(session)
        models.save(model, models.fit("nearest", data, patch="none"), data)
    shutil.copytree(model, session.models / "nearest")
    shutil.copy(root.parent / "weather.csv", root / "weather.csv")
    year = root / "annual" / "nearest"
    predict.run(
        session.models / "nearest", root / "weather.csv", out=year, maps=True, scheduler=scheduler
    )
    parts = ("truth", "sunpatches", "annual")
    paths = [p for part in parts for p in [root / part, *(root / part).rglob("*")] if p.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


@pytest.fixture(autouse=True)
def weather_file(running: Cluster) -> None:
    """Ten days of March with sun: two units of hours."""
    rng = np.random.default_rng(0)
    lines = ["month,day,hour,dni_wm2,dhi_wm2"]
    for day in range(10, 20):
        for hour in range(24):
            dni, dhi = rng.uniform(0, 800), rng.uniform(60, 250)
            light = (dni, dhi) if 7 <= hour < 17 else (0.0, 0.0)
            lines.append(f"3,{day},{hour + 0.5},{light[0]:.0f},{light[1]:.0f}")
    (running.shared / "weather.csv").write_text("\n".join(lines) + "\n")


def test_killed_full_and_other_workers_cost_their_units_alone(
    running: Cluster, scheduler: Scheduler
) -> None:
    """Forty units write a file each; one worker is killed, one has a full disk."""
    names = [f"n{k}.txt" for k in range(40)]
    folder = running.shared
    full = {"name": "full", "how": "full", "times": 1}
    some = [WorkUnit("full", units.troubled, folder, full)]
    some += [
        WorkUnit(name, units.written, folder, {"name": name, "seconds": 0.2}) for name in names
    ]
    running.worker("third")
    outcomes: list[UnitOutcome] = []
    killed: list[int] = []  # outcomes before the kill

    def take(outcome: UnitOutcome) -> None:
        outcomes.append(outcome)
        # not before the full disk is known: the killed worker could be the one that had it
        if not killed and any("No space left" in str(note.message) for note in notes):
            running.signal("first")
            killed.append(len(outcomes))

    with pytest.warns(Caution) as notes:
        run_each(some, parse_scheduler(str(running.file)), take)
    done = [o.unit.name for o in outcomes]
    assert sorted(done) == sorted([*names, "full"]), "none twice"
    assert killed and killed[0] < 30, "killed while units remained"
    assert not [o.error for o in outcomes if o.error]
    written = (folder / "out").glob("[!.]*")  # a killed worker can leave a hidden file
    assert sorted(path.name for path in written) == sorted(names)
    text = "\n".join(str(note.message) for note in notes)
    assert "rejected: source" in text and "install the versions of this computer there" in text
    assert "No space left on device; it gets no further units" in text


def test_without_a_usable_worker_the_command_ends(
    running: Cluster, scheduler: Scheduler, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = {**software(), "source": "other"}
    monkeypatch.setattr("fieldlum.core.scheduler.software", lambda: other)
    monkeypatch.setattr("fieldlum.core.scheduler._WORKER_REPLACEMENT_S", 2.0)
    unit = WorkUnit("a", units.doubled, running.shared, 1)
    with (
        pytest.warns(Caution, match="it gets no further units"),
        pytest.raises(InputError, match=r"no usable worker is left .* \(here other\)"),
    ):
        units.outcomes_of([unit], scheduler)
