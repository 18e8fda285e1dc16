"""`merge` over a session: skipping, provenance, verdicts, the survey, and the command."""

import csv
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from click.testing import CliRunner
from msgspec import structs

from fieldlum import merge
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import (
    CameraSetup,
    Exposure,
    Site,
    SiteFile,
    Slot,
    SunSource,
    slot_id,
    utc_text,
)
from fieldlum.core.scheduler import Scheduler
from fieldlum.merge import MergeOptions, MergeResult, stage
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.images import read_panorama, read_radiance_hdr
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.raw.writing import write_dng
from fieldlum.session import Session, create_session
from fieldlum.session.files.sidecar import readable_sidecars

TIMES_S = (0.5, 1 / 15, 1 / 125)
START = datetime(2027, 3, 20, 6, 30, tzinfo=UTC)  # night in Greenwich: no sun to take out
SMALL = MergeOptions(height=16)


def profile() -> CameraProfile:
    return CameraProfile(
        CameraBody("small", "raw", 128, 64),
        (Lens((64.0, 32.0), 31.0, 180.0),),
        Bracket(4.0, 100.0, TIMES_S),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )


def take(session: Session, number: int, *, light: float = 200.0, complete: bool = True) -> str:
    """One bracket of a uniform room, with its capture.json."""
    t_utc = START + timedelta(hours=number)
    folder = session.raw / slot_id(t_utc)
    folder.mkdir(parents=True)
    rng, frames = np.random.default_rng(number), []
    for i, t in enumerate(TIMES_S):
        true_s = {1 / 15: 1 / 16, 1 / 125: 1 / 128}.get(t, t)
        mean = light * z_per_cdm2(true_s, 4.0, 100.0) * (4095 - 256)
        noise = np.sqrt(mean / 2 + (5 / 2) ** 2)
        counts = np.clip(np.round(256 + mean + noise * rng.standard_normal((64, 128))), 0, 4000)
        exposure = Exposure(t, 4.0)
        write_dng(
            folder / f"{i}.dng",
            counts.astype(np.uint16),
            exposure,
            black_dn=(256,) * 4,
            white_dn=4095,
        )
        frames.append(
            {
                "file": f"{i}.dng",
                "exposure": {"shutter_s": t, "f_number": 4.0, "iso": 100.0, "nd": ""},
                "heading_deg": None,
                "t_utc": utc_text(t_utc + timedelta(seconds=10 * i)),
            }
        )
    note = {
        "t_open_utc": utc_text(t_utc),
        "t_close_utc": utc_text(t_utc + timedelta(seconds=30)),
        "frames": frames,
    }
    (folder / "capture.json").write_text(
        json.dumps({**note, "complete": complete}), encoding="utf-8"
    )
    return folder.name


@pytest.fixture
def session(tmp_path: Path) -> Session:
    save_profile(tmp_path / "small.toml", profile())
    setup = SiteFile(Site("here", 51.5, 0.0), CameraSetup(str(tmp_path / "small.toml"), 180.0))
    return create_session(
        tmp_path / "s", setup, [Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))], {}
    )


@pytest.mark.slow
@pytest.mark.contract
def test_brackets_become_panoramas_and_are_kept(session: Session) -> None:
    slots = [take(session, 0), take(session, 1, complete=False)]
    first = merge.run(session, SMALL)
    assert [(v.slot, v.state) for v in first] == [(slots[0], "merged"), (slots[1], "merged")]
    assert "incomplete" in first[1].text and "incomplete" not in first[0].text
    panorama = read_panorama(session.panoramas / f"{slots[0]}.exr")
    assert panorama.flags is not None and panorama.t_utc == START + timedelta(seconds=15)
    seen = panorama.flags == 0
    assert 0.35 < seen.mean() < 0.6  # one lens of 180 degrees
    assert np.median(panorama.luminance_cdm2[seen]) == pytest.approx(200.0, rel=0.01)
    note = json.loads((session.panoramas / f"{slots[0]}.json").read_text())
    assert [len(f["sha256"]) for f in note["inputs"]["frames"]] == [64, 64, 64]
    assert note["profile"]["name"] == "small" and note["factors"]["k"] == 1.0

    assert [v.state for v in merge.run(session, SMALL)] == ["kept", "kept"]
    assert [v.state for v in merge.run(session, SMALL, force=True)] == ["merged", "merged"]
    (session.panoramas / f"{slots[0]}.json").unlink()
    assert [v.state for v in merge.run(session, SMALL)] == ["merged", "kept"]


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_two_workers_write_the_files_of_one(session: Session) -> None:
    slots = [take(session, number) for number in range(2)]

    def written(workers: int) -> dict[str, bytes]:
        merge.run(session, SMALL, scheduler=Scheduler(workers), force=True)
        return {path.name: path.read_bytes() for path in session.panoramas.glob("*.*")}

    alone = written(1)
    assert len(alone) >= 4 and written(2) == alone
    for path in session.panoramas.glob("*.*"):
        path.unlink()
    with merge.merging(session, SMALL) as merge_early:
        merge_early(slots[0]).result()
    assert [v.state for v in merge.run(session, SMALL)] == ["kept", "merged"]
    assert {path.name: path.read_bytes() for path in session.panoramas.glob("*.*")} == alone
    assert [v.state for v in merge.run(session, MergeOptions(height=20))] == ["merged", "merged"]


@pytest.mark.contract
def test_a_sun_on_few_pixels_says_how_well_it_is_known(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    for origin, note in (
        (
            "nd-frames",
            "the sun is only 0.2 px wide on the sensor, so the uncertainty of the sun's "
            "illuminance is 50 %",
        ),
        ("clipped", ""),
    ):  # a lower bound says so already
        sun = SunSource(25.0, 190.0, 60_000.0, 1.0, origin)

        def with_sun(*given: Any, sun: SunSource = sun, **options: Any) -> MergeResult:
            result = merge.merge_shots(*given, **options)
            return replace(result, panorama=replace(result.panorama, sun=sun))

        monkeypatch.setattr(stage, "merge_shots", with_sun)
        slot = take(session, 0 if note else 1)
        verdict = next(v for v in merge.run(session, SMALL) if v.slot == slot)
        assert verdict.text.endswith(note) and ("px wide" in verdict.text) == bool(note)
        side = json.loads((session.panoramas / f"{slot}.json").read_text())
        assert side["sun"]["u_mosaic_percent"] == 50.0 and side["verdict"] == verdict.text


@pytest.mark.contract
def test_one_bad_bracket_stops_nothing(session: Session) -> None:
    slots = [take(session, 0), take(session, 1)]
    for name in ("0.dng", "1.dng"):
        (session.raw / slots[0] / name).write_bytes(b"no raw")
    verdicts = merge.run(session, SMALL)
    assert [v.state for v in verdicts] == ["failed", "merged"]
    assert "0.dng" in verdicts[0].text
    assert not (session.panoramas / f"{slots[0]}.exr").exists()


@pytest.mark.contract
def test_a_frame_that_cannot_be_read_costs_no_bracket(session: Session) -> None:
    """It is merged without it, says so each time, and is whole again once the frame is."""
    slot = take(session, 0)
    frame = session.raw / slot / "1.dng"
    data = frame.read_bytes()
    frame.write_bytes(data[: len(data) // 2])
    for _ in range(2):
        verdict = merge.run(session, SMALL)[0]
        assert verdict.state == "merged"
        assert verdict.text.startswith(
            "merged without 1.dng, because the pixels cannot be read: copy these frames from the "
            "card again; "
        )
    note = json.loads((session.panoramas / f"{slot}.json").read_text())
    assert note["quality"]["lost"] == ["1.dng"] and note["verdict"] == verdict.text
    panorama = read_panorama(session.panoramas / f"{slot}.exr")
    assert panorama.flags is not None
    assert np.median(panorama.luminance_cdm2[panorama.flags == 0]) == pytest.approx(200.0, rel=0.02)
    frame.write_bytes(data)
    assert merge.run(session, SMALL)[0].text.startswith("good")


@pytest.mark.contract
def test_an_empty_session_has_nothing_to_merge(session: Session) -> None:
    with pytest.raises(NotEnoughDataError):
        merge.run(session)


@pytest.mark.contract
def test_a_folder_without_capture_json_is_read_by_exif(session: Session) -> None:
    slot = take(session, 0)
    (session.raw / slot / "capture.json").unlink()
    assert merge.run(session, SMALL)[0].state == "merged"
    assert read_panorama(session.panoramas / f"{slot}.exr").t_utc == START


@pytest.mark.contract
def test_a_long_caption_of_the_survey_stays_in_its_place(session: Session) -> None:
    """Verdicts ran over the captions of the next brackets, so that bad ones could not be read."""
    take(session, 0)
    merge.run(session, SMALL)
    (sidecar,) = readable_sidecars(session.sidecar_files())
    long = "merged without IMG_0030.DNG, because the pixels are gone " * 3
    told = structs.replace(sidecar, verdict=long)
    sheet = stage._sheet(session, [told], ZoneInfo("UTC"))
    assert (sheet[:138, 188:] == 255).all()
    assert all((sheet[y : y + 13, :188] < 128).any() for y in (94, 107, 120))  # three lines


@pytest.mark.contract
def test_the_survey_lists_every_bracket(session: Session) -> None:
    slots = [take(session, 0), take(session, 1)]
    own = session.panoramas / "contact-2 of May.png"
    for page in (own, session.panoramas / "contact-2.png", session.panoramas / "contact-3.png"):
        page.parent.mkdir(exist_ok=True)
        page.touch()  # of an earlier merge of more brackets
    merge.run(session, SMALL)
    with (session.panoramas / "quality.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["slot"] for r in rows] == slots and rows[0]["frames"] == "3"
    assert (session.panoramas / "contact-1.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in session.panoramas.glob("contact*")) == ["contact-1.png", own.name]


# ----------------------------------------------------------------------------------------------
# contract: the command


@pytest.mark.contract
def test_the_command_on_a_session(session: Session) -> None:
    slot = take(session, 0)
    result = CliRunner().invoke(main, ["merge", str(session.root), "--size", "32x16", "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["slots"][0]["slot"] == slot and answer["slots"][0]["state"] == "merged"


@pytest.mark.contract
@pytest.mark.parametrize("projection", ["equirect", "fisheye"])
@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_the_command_on_files(
    session: Session, tmp_path: Path, projection: str, suffix: str
) -> None:
    slot = take(session, 0)
    frames = sorted(str(p) for p in (session.raw / slot).glob("*.dng"))
    frames = [str(session.raw / slot)] if suffix == ".hdr" else frames
    out = tmp_path / f"picture{suffix}"
    size = "32x16" if projection == "equirect" else "24x24"
    options = [
        "--camera",
        str(tmp_path / "small.toml"),
        "--out",
        str(out),
        "--projection",
        projection,
        "--size",
        size,
    ]
    result = CliRunner().invoke(main, ["merge", "--frames", *frames, *options, "--json"])
    assert result.exit_code == 0, result.output
    ev = json.loads(result.stdout)["vertical_illuminance_lx"]
    assert ev == pytest.approx(
        200 * np.pi, rel=0.05
    )  # the outermost ring of a lens of 62 pixels is not used
    if suffix == ".hdr":
        picture, header = read_radiance_hdr(out)
        assert header.view.startswith("-vta -vd 0.000000 -1.000000 " * (projection == "fisheye"))
        assert bool(header.view) == (projection == "fisheye")
        assert picture.luminance_cdm2[picture.luminance_cdm2 > 100] == pytest.approx(200, rel=0.05)


@pytest.mark.contract
def test_exit_codes(session: Session, tmp_path: Path) -> None:
    def code(*arguments: str) -> int:
        return CliRunner().invoke(main, ["merge", *arguments]).exit_code

    camera = str(tmp_path / "small.toml")
    assert code() == 2 and code("--frames", "a.dng") == 2
    assert code(str(session.root), "--size", "30x20") == 2
    assert code(str(tmp_path)) == 3  # no session
    assert code(str(session.root)) == 5  # nothing captured
    assert code("--frames", str(tmp_path / "none.dng"), "--camera", camera, "--out", "x.hdr") == 3
    assert code("--frames", camera, "--camera", camera, "--out", "x.png") == 3
    (tmp_path / "empty" / "bracket").mkdir(parents=True)
    (tmp_path / "empty" / "bracket" / "a.dng").touch()  # brackets of subfolders are not mixed
    options = ["--frames", str(tmp_path / "empty"), "--camera", camera, "--out", "x.hdr"]
    assert "no frames in this folder" in CliRunner().invoke(main, ["merge", *options]).output
    assert code("--frames", camera, "--camera", "no-such-camera", "--out", "x.hdr") == 3


@pytest.mark.contract
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("radius_px = 31.0", "radius_px = 0.0"),
        ("gain_e_per_dn = 2.0", "gain_e_per_dn = inf"),
        ("k = 1.0", "k = -1.0"),
    ],
)
def test_figures_that_no_camera_has_are_refused(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "small.toml"
    save_profile(path, profile())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match="small"):
        load_camera_profile(path)


@pytest.mark.contract
@pytest.mark.parametrize("projection", ["equirect", "fisheye"])
def test_the_illuminance_of_a_narrow_lens_is_unknown(
    session: Session, tmp_path: Path, projection: str
) -> None:
    """What no lens saw would count as black."""
    slot, narrow = take(session, 0), tmp_path / "narrow.toml"
    wide = (tmp_path / "small.toml").read_text()
    narrow.write_text(re.sub(r"full_angle_deg = .*", "full_angle_deg = 120.0", wide))
    size = "32x16" if projection == "equirect" else "24x24"
    words = ["merge", "--frames", str(session.raw / slot), "--camera", str(narrow), "--size", size]
    words += ["--projection", projection, "--out"]
    told = CliRunner().invoke(main, [*words, str(tmp_path / "a.exr")])
    assert told.exit_code == 0 and "vertical_illuminance_lx: unknown" in told.stdout, told.output
    answer = CliRunner().invoke(main, [*words, str(tmp_path / "b.exr"), "--json"])
    assert json.loads(answer.stdout)["vertical_illuminance_lx"] is None
