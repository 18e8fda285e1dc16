"""Results with a recorded sha256: a changed number is reported by each reader."""

import shutil
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny_field import make_session

from fieldlum.cli import main
from fieldlum.core.errors import ChangedFileWarning
from fieldlum.core.records import Panorama
from fieldlum.optics.images import write_panorama
from fieldlum.session import sha256
from fieldlum.session.codec import current_note, sealed, write_csv
from fieldlum.session.files.hourly_csv import HOUR_COLUMNS, VIEW_COLUMNS, HourlyFile
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.model_files import ScoresFile
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import Sidecar, warn_if_picture_changed
from fieldlum.session.panorama_sun import (
    SunRow,
    read_panorama_with_sun,
    read_suns,
    write_suns,
)
from fieldlum.sky.sky_view.picture import SkyGrid
from fieldlum.sky.sky_view.view import CHANNELS, SkyView
from fieldlum.year.glare.uncertainty_budget import COLUMNS, read_budgets

NOON = datetime(2027, 6, 21, 12, tzinfo=UTC)


def pairs(folder: Path) -> Path:
    PairsFile(folder / "pairs.csv", (PairRow(NOON, "a.exr", 231.0, 120.0),)).write()
    return folder / "pairs.csv"


def clean(folder: Path) -> Path:
    text = np.array(["measured"], object)
    t, ghi, dhi, dni = (np.array([x]) for x in (NOON.timestamp(), 300.0, 120.0, 231.0))
    CleanIrradiance(
        t_unix_s=t, ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni, source=text, flags=text
    ).write(folder / "clean.csv")
    return folder / "clean.csv"


def hourly(folder: Path) -> Path:
    hours = {name: np.array([231.0]) for name in HOUR_COLUMNS}
    views = {name: np.array([[0.3]]) for name in VIEW_COLUMNS}
    HourlyFile((NOON,), np.array([180.0]), hours, views).write(folder, "UTC")
    return folder / "hourly.csv"


def predict(folder: Path) -> Path:
    PredictFile(model="231", azimuths_deg=(180.0,), hours=1).write(folder)
    return folder / "predict.json"


def scores(folder: Path) -> Path:
    ScoresFile((), "dense", parameters=231).write(folder)
    return folder / "scores.json"


def suns(folder: Path) -> Path:
    row = SunRow("panoramas/a.exr", 30.0, 180.0, 231.0, 1.0, "dni", 0.0)
    write_suns(folder / "suns.csv", [row])
    return folder / "suns.csv"


def budget(folder: Path) -> Path:
    row = ("", "DGP", "180", ".3", "", "k", "", "", ".231", "", "1", ".02", "100", "")
    path = folder / "budget.csv"
    with sealed(path):
        write_csv(path, [dict(zip(COLUMNS, row, strict=True))])
    return path


READERS: dict[Callable[[Path], Path], Callable[[Path], object]] = {
    pairs: PairsFile.read,
    clean: CleanIrradiance.read,
    hourly: lambda path: HourlyFile.read(path.parent, np.array([180.0]), 1),
    predict: lambda path: PredictFile.read(path.parent),
    scores: lambda path: ScoresFile.read(path.parent),
    suns: read_suns,
    budget: read_budgets,
}


@pytest.mark.contract
@pytest.mark.parametrize("write", READERS, ids=lambda write: write.__name__)
def test_a_changed_number_is_reported_until_the_file_is_accepted(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    path, read = write(tmp_path), READERS[write]
    read(path)
    content = path.read_bytes()
    changed = content.replace(b"231", b"131")
    path.write_bytes(changed)
    with pytest.warns(ChangedFileWarning, match=f"{path.name}: the content changed after"):
        read(path)
    accepted = tmp_path / "accepted"
    accepted.mkdir()
    read(Path(shutil.copy(path, accepted)))  # as a file that a user or an earlier version wrote
    path.write_bytes(content)
    read(path)
    path.write_bytes(changed)
    read(write(tmp_path))  # written again


@pytest.mark.contract
def test_the_digest_has_the_form_of_sha256sum(tmp_path: Path) -> None:
    path = pairs(tmp_path)
    digest, name = (tmp_path / "pairs.csv.sha256").read_text().split()
    assert len(digest) == 64 and name == path.name


@pytest.mark.contract
def test_an_interrupted_write_leaves_no_false_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = pairs(tmp_path)

    def killed(path: Path) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("fieldlum.session.codec.sha256", killed)
    with pytest.raises(KeyboardInterrupt):
        PairsFile(path, (PairRow(NOON, "b.exr", 131.0, 120.0),)).write()
    monkeypatch.undo()
    assert PairsFile.read(path).rows[0].panorama == "b.exr"


@pytest.mark.contract
def test_pairs_carry_the_warning_into_training_and_commands_print_it(tmp_path: Path) -> None:
    path = predict(tmp_path)
    path.write_text(path.read_text().replace("231", "131"))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = CliRunner().invoke(main, ["info", str(tmp_path)])
    assert result.stderr.startswith(f"WARNING: {path}: the content changed after fieldlum wrote it")
    table = pairs(tmp_path)
    table.write_text(table.read_text().replace("231", "131"))
    with pytest.warns(ChangedFileWarning):
        assert "delete pairs.csv.sha256" in PairsFile.read(table).warnings[0]


@pytest.mark.contract
def test_a_result_that_is_kept_or_shown_is_reported_too(tmp_path: Path) -> None:
    """A stage that finds its result up to date does not read all of it; `info` reads any csv."""
    note, table = predict(tmp_path), hourly(tmp_path)
    inputs = PredictFile.read(tmp_path).inputs
    for path in (note, table):
        whole = path.read_text()
        path.write_text(whole.replace("231", "131"))
        with pytest.warns(ChangedFileWarning, match=f"{path.name}: the content changed after"):
            assert current_note(note, inputs, [table]) is not None
        path.write_text(whole)
    table.write_text(whole.replace("231", "131"))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = CliRunner().invoke(main, ["info", str(table)])
    assert result.stderr.startswith(f"WARNING: {table}: the content changed after fieldlum wrote")


@pytest.mark.contract
def test_a_panorama_that_decays_after_its_merge_is_reported(tmp_path: Path) -> None:
    """The recorded sha256 is in SLOT.json; one of 0.1.0 has none."""
    path = tmp_path / "panoramas" / "20270621T120000Z.exr"
    path.parent.mkdir()
    write_panorama(path, Panorama(np.full((8, 16), 231.0, np.float32), 180.0))
    sidecar = Sidecar(path.stem, sha256=sha256(path))
    sidecar.write(path.with_suffix(".json"))
    read_panorama_with_sun(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert not sidecar.fits(path) and Sidecar(path.stem).fits(path)
    with pytest.warns(ChangedFileWarning, match=r"changed after merge wrote it.*fieldlum merge"):
        warn_if_picture_changed(path)
    path.write_bytes(whole)
    warn_if_picture_changed(path)


@pytest.mark.contract
def test_an_edited_plan_sidecar_or_sky_view_is_reported(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    session.plan.write_text(session.plan.read_text().replace(",10.000,", ",11.000,"))
    with pytest.warns(ChangedFileWarning, match=r"plan\.csv: the content changed"):
        session.slots()
    sidecar = tmp_path / "20270621T120000Z.json"
    Sidecar(sidecar.stem, verdict="check 231").write(sidecar)
    Sidecar.read(sidecar)
    sidecar.write_text(sidecar.read_text().replace("check 231", "good"))
    with pytest.warns(ChangedFileWarning, match=sidecar.name):
        Sidecar.read(sidecar)
    share = np.zeros((16, 32), np.float32)
    view = SkyView(
        SkyGrid(
            first_altitude_deg=90.0,
            first_azimuth_deg=0.0,
            step_deg=11.25,
            heading_deg=180.0,
            height=16,
            width=32,
        ),
        **dict.fromkeys(CHANNELS, share),
    )
    view.write(tmp_path / "sky_view.exr")
    SkyView.read(tmp_path / "sky_view.exr")
    note = tmp_path / "sky_view.exr.sha256"
    note.write_text("0" * 64 + note.read_text()[64:])
    with pytest.warns(ChangedFileWarning, match=r"sky_view\.exr: the content changed"):
        SkyView.read(tmp_path / "sky_view.exr")
