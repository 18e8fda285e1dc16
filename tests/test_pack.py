"""`pack`: what travels in a published session, and what does not."""

import hashlib
import json
import warnings
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image
from places import SEATTLE

from fieldlum.cli import main
from fieldlum.core.records import CameraSetup, Flag, Panorama, SiteFile, Slot
from fieldlum.optics.images import write_panorama
from fieldlum.optics.profiles import find_camera_profile
from fieldlum.session import Session, create_session
from fieldlum.session.files.pairs_csv import PairRow, PairsFile

NOON = datetime(2027, 3, 20, 20, 0, tzinfo=UTC)
ID = "20270320T200000Z"


@pytest.fixture
def session(tmp_path: Path) -> Session:
    site = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0))
    made = create_session(tmp_path / "office", site, [Slot(NOON, 30.0, 180.0, ())], {})
    with made.toml.open("a") as file:
        file.write('[devices.uris]\ncamera = "rpicam:secret-host"\n')
    (made.raw / ID).mkdir(parents=True)
    made.panoramas.mkdir(exist_ok=True)
    flags = np.zeros((8, 16), np.uint16)
    flags[2:4] = Flag.MOTION
    write_panorama(made.panorama(ID), Panorama(np.ones((8, 16), np.float32), 180.0, None, flags))
    (made.root / "outbox.jsonl").write_text("private")
    frame(made)
    return made


def frame(session: Session, *, gps: bool = False) -> None:
    exif = Image.Exif()
    if gps:
        exif.get_ifd(0x8825)[1] = "N"
    Image.new("RGB", (8, 8)).save(session.raw / ID / "00.jpg", exif=exif)


def pack(session: Session, *more: str) -> Result:
    out = str(session.root.parent / "out.zip")
    about = ["--title", "Office", "--author", "Roe, Jo", "--licence", "CC-BY-4.0"]
    about += ["--publisher", "Zenodo"]
    return CliRunner().invoke(
        main, ["pack", str(session.root), out, *about, "--people", "none", *more]
    )


@pytest.mark.contract
def test_a_packed_session_has_metadata_and_checksums_and_no_addresses(session: Session) -> None:
    ran = pack(session)
    assert ran.exit_code == 0, ran.output
    assert f"perhaps people: look at the frames of {ID}" in ran.output
    with zipfile.ZipFile(session.root.parent / "out.zip") as archive:
        content = {name.removeprefix("office/"): archive.read(name) for name in archive.namelist()}
    assert {"DATASHEET.md", "datacite.json", f"raw/{ID}/00.jpg"} <= content.keys()
    assert not any(b"secret-host" in data for data in content.values())
    assert "outbox.jsonl" not in content
    assert json.loads(content["datacite.json"])["dates"][0]["date"] == "2027-03-20/2027-03-20"
    assert json.loads(content["datacite.json"])["publisher"] == {"name": "Zenodo"}
    for line in content["MANIFEST.sha256"].decode().splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.sha256(content[name]).hexdigest() == digest


@pytest.mark.contract
def test_a_profile_of_ones_own_is_packed_without_its_folder(session: Session) -> None:
    own = session.root.parent / "home" / "alice" / "mine.toml"
    own.parent.mkdir(parents=True)
    own.write_bytes(find_camera_profile("sim-fisheye").read_bytes())
    text = session.toml.read_text().replace('profile = ""', f'profile = "{own}"')
    session.toml.write_text(text + '[devices.camera]\nserial = "123"\n')
    ran = pack(session)
    assert ran.exit_code == 0 and "serial numbers of the devices" in ran.output
    with zipfile.ZipFile(session.root.parent / "out.zip") as archive:
        assert archive.read("office/calibration/mine.toml") == own.read_bytes()
        assert 'profile = "calibration/mine.toml"' in archive.read("office/session.toml").decode()
        assert b"alice" not in archive.read("office/DATASHEET.md")
        about = json.loads(archive.read("office/datacite.json"))
    assert about["publicationYear"] == str(datetime.now(UTC).year)
    own.unlink()
    (session.root.parent / "out.zip").unlink()
    assert "profile mine.toml is not found" in pack(session).output


@pytest.mark.contract
def test_a_table_that_was_changed_is_not_packed_silently(session: Session) -> None:
    """The archive has no pairs.csv.sha256."""
    PairsFile(session.pairs, (PairRow(NOON, f"panoramas/{ID}.exr", 231.0, 120.0),)).write()
    session.pairs.write_text(session.pairs.read_text().replace("231", "131"))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert f"WARNING: {session.pairs}: the content changed" in pack(session).stderr


@pytest.mark.contract
def test_an_archive_never_replaces_a_file(session: Session) -> None:
    (session.root.parent / "out.zip").write_text("precious")
    ran = pack(session)
    assert ran.exit_code == 3 and "out.zip: it exists" in ran.output, ran.output
    assert (session.root.parent / "out.zip").read_text() == "precious"


@pytest.mark.contract
@pytest.mark.parametrize(
    ("tag", "value", "found"),
    [(0x013B, "Jo Roe", "owner"), (0xC62F, "123", "serial"), (0x8825, None, "position")],
)
def test_private_exif_of_a_raw_frame_is_refused(
    session: Session, tag: int, value: str | None, found: str
) -> None:
    exif = Image.Exif()
    if value is None:
        exif.get_ifd(tag)[2] = (47.0, 36.0, 0.0)
    else:
        exif[tag] = value
    # Pillow cannot open the pixels of a raw file: its tags are read all the same.
    (session.raw / ID / "01.dng").write_bytes(exif.tobytes()[6:])
    assert found in pack(session).output


@pytest.mark.contract
def test_a_gps_version_is_no_position_and_an_unreadable_frame_is_named(session: Session) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8825)[0] = b"\2\3\0\0"
    Image.new("RGB", (8, 8)).save(session.raw / ID / "00.jpg", exif=exif)
    (session.raw / ID / "01.cr3").write_bytes(b"\0\0\0\x18ftypcrx ")
    ran = pack(session)
    assert ran.exit_code == 0 and "EXIF of 1 frame such as 01.cr3" in ran.output, ran.output


@pytest.mark.contract
def test_a_session_named_by_a_dot_is_packed_below_its_name(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(session.root)
    about = ["--title", "Office", "--author", "Daylight Group", "--people", "none"]
    about += ["--publisher", "Zenodo"]
    ran = CliRunner().invoke(main, ["pack", ".", "../dot.zip", *about, "--licence", "CC0-1.0"])
    assert ran.exit_code == 0, ran.output
    with zipfile.ZipFile("../dot.zip") as archive:
        assert all(name.startswith("office/") for name in archive.namelist())
        assert "- **Who**: Daylight Group." in archive.read("office/DATASHEET.md").decode()


@pytest.mark.contract
@pytest.mark.parametrize(
    "more",
    [
        ["--title", " "],
        ["--licence", "CC BY"],
        ["--licence", "free"],
        ["--author", ""],
        ["--publisher", ""],
    ],
)
def test_an_empty_statement_is_a_usage_error(session: Session, more: list[str]) -> None:
    assert pack(session, *more).exit_code == 2


@pytest.mark.contract
def test_a_frame_with_a_position_is_refused(session: Session) -> None:
    frame(session, gps=True)
    ran = pack(session)
    assert ran.exit_code == 3 and "00.jpg (a position)" in ran.output, ran.output
    assert not (session.root.parent / "out.zip").exists()


@pytest.mark.contract
@pytest.mark.parametrize("command", ["pack", "export"])
def test_a_session_without_results_is_refused(tmp_path: Path, command: str) -> None:
    site = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0))
    empty = create_session(tmp_path / "empty", site, [Slot(NOON, 30.0, 180.0, ())], {})
    ran = (
        CliRunner().invoke(main, ["export", str(empty.root)])
        if command == "export"
        else pack(empty)
    )
    assert ran.exit_code == 5 and "empty: no" in ran.output, ran.output
    assert not (empty.root / "export").exists()
