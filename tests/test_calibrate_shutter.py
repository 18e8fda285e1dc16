"""`calibrate shutter`: true times from many merged brackets, and what a later merge gains by
them.
"""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from click.testing import CliRunner
from msgspec import structs

from fieldlum import merge
from fieldlum.calibrate import shutter
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot, slot_id, utc_text
from fieldlum.merge import MergeOptions, merge_shots, shots_of_files
from fieldlum.optics.exposure import z_per_cdm2
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
from fieldlum.session import Session, create_session, exposure_text, sha256
from fieldlum.session.files.sidecar import Sidecar

START = datetime(2027, 3, 20, 6, 30, tzinfo=UTC)
# Dial and truth: off the snapped times (1/4, 1/16, 1/64, 1/256, 1/1024 s) by +0.6, -1.4, +1.8, -2.2
# and +4.0 %.
TRUE_S = {
    1 / 4: 1.006 / 4,
    1 / 15: 0.986 / 16,
    1 / 60: 1.018 / 64,
    1 / 250: 0.978 / 256,
    1 / 1000: 1.04 / 1024,
}
OFF = np.array([1.006, 0.986, 1.018, 0.978, 1.04])


def profile(kind: Literal["raw", "jpeg"] = "raw") -> CameraProfile:
    return CameraProfile(
        CameraBody("small", kind, 160, 80),
        (Lens((80.0, 40.0), 39.0, 180.0),),  # type: ignore[arg-type]
        Bracket(4.0, 100.0, tuple(TRUE_S)),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )


def frame(
    path: Path, nominal_s: float, light: np.ndarray | float, rng: np.random.Generator
) -> Path:
    mean = (
        np.broadcast_to(light, (80, 160)) * z_per_cdm2(TRUE_S[nominal_s], 4.0, 100.0) * (4095 - 256)
    )
    noise = np.sqrt(mean / 2 + (5 / 2) ** 2) * rng.standard_normal((80, 160))
    counts = np.clip(np.round(256 + mean + noise), 0, 4000).astype(np.uint16)
    write_dng(path, counts, Exposure(nominal_s, 4.0), black_dn=(256,) * 4, white_dn=4095)
    return path


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Seven merged brackets of a room with bright and dark parts."""
    folder = tmp_path_factory.mktemp("shutter")
    save_profile(folder / "small.toml", profile())
    setup = SiteFile(Site("here", 51.5, 0.0), CameraSetup(str(folder / "small.toml"), 180.0))
    session = create_session(
        folder / "s", setup, [Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))], {}
    )
    light = np.geomspace(2, 10_000, 160)
    for number in range(7):
        t_utc, rng, frames = START + timedelta(minutes=number), np.random.default_rng(number), []
        folder = session.raw / slot_id(t_utc)
        folder.mkdir(parents=True)
        for i, nominal in enumerate(TRUE_S):
            path = frame(folder / f"{i}.dng", nominal, light * (1 + 0.1 * number), rng)
            at = utc_text(t_utc + timedelta(seconds=2 * i))
            known = {"shutter_s": nominal, "f_number": 4.0, "iso": 100.0}
            frames.append({"file": path.name, "exposure": known, "t_utc": at})
        (folder / "capture.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")
    merge.run(session, merge.MergeOptions(height=12))
    return session


def relative(times: np.ndarray) -> np.ndarray:
    """Times over the truth; their common level, which pictures cannot tell, taken off."""
    off = np.log(times / np.array(list(TRUE_S.values())))
    return np.exp(off - off[:3].mean())


@pytest.mark.slow
@pytest.mark.contract
def test_a_merged_session_gives_the_times_to_the_profile(session: Session, tmp_path: Path) -> None:
    camera, out = session.root.parent / "small.toml", tmp_path / "new.toml"
    words = [
        "calibrate",
        "shutter",
        str(session.root),
        "--camera",
        str(camera),
        "--out",
        str(out),
        "--json",
    ]
    ran = CliRunner().invoke(main, [*words, "--picture", str(tmp_path / "s.png")])
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    new = load_camera_profile(out)
    assert [t.nominal_s for t in new.shutter] == pytest.approx(list(TRUE_S))
    assert [row["brackets"] for row in found["times"]] == [7] * 5 and "held-out rms" in found[
        "why"
    ][0]
    true = np.array([t.true_s for t in new.shutter])
    u = np.array([t.u_rel for t in new.shutter])
    assert relative(true) == pytest.approx(np.ones(5), abs=2e-3) and np.all(u < 2e-3)
    assert (tmp_path / "s.png").stat().st_size > 1000
    assert "shutter: table" in new.provenance.log[-1] and len(new.provenance.frames_sha256) == 7

    # A later bracket whose frames hardly overlap: one value each, known by nothing but the time.
    errors = {}
    for name, p in (("dial", profile()), ("table", new)):
        values = []
        for number, nominal in enumerate((1 / 60, 1 / 250, 1 / 1000)):
            path = frame(
                tmp_path / f"{name}{number}.dng",
                nominal,
                0.8 / z_per_cdm2(nominal, 4.0, 100.0),
                np.random.default_rng(number),
            )
            panorama = merge_shots(shots_of_files([path]), p, MergeOptions(height=12)).panorama
            seen = np.asarray(panorama.flags) == 0
            values.append(
                np.median(panorama.luminance_cdm2[seen]) * z_per_cdm2(nominal, 4.0, 100.0) / 0.8
            )
        errors[name] = np.ptp(np.log(values))
    assert errors["dial"] > 0.05 and errors["table"] < 5e-3


@pytest.mark.slow
@pytest.mark.contract
def test_refusals_are_one_line(session: Session, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    save_profile(other, load_camera_profile("sim-dual-fisheye"))
    ran = CliRunner().invoke(
        main,
        [
            "calibrate",
            "shutter",
            str(session.root),
            "--camera",
            str(other),
            "--out",
            str(tmp_path / "n.toml"),
        ],
    )
    assert ran.exit_code == 3 and "another profile" in ran.stderr and ran.stderr.count("\n") == 1
    brackets, _ = shutter.from_session(session, sha256(session.root.parent / "small.toml"))
    with pytest.raises(NotEnoughDataError, match="both times: 4, needed: 5"):
        shutter.fit(brackets[:4], profile())
    with pytest.raises(InputError, match="JPEG"):
        shutter.fit(brackets, profile("jpeg"))


# ----------------------------------------------------------------------------------------------
# analytic


def quality(off: np.ndarray, rate: float = 0.0, headings: int = 1, nd: str = "") -> Sidecar:
    """A sidecar's figures where the merge left everything to the neighbours' residual
    (corrections 1).
    """
    log = np.log(off) + rate * 2.0 * np.arange(len(off))
    texts = [
        exposure_text(Exposure(t, 4.0, 100.0, nd if i == 4 else "")) for i, t in enumerate(TRUE_S)
    ]
    frames = [
        {
            "exposure": text,
            "correction": 1.0,
            "heading_deg": 180.0 * h,
            "t_utc": utc_text(START + timedelta(seconds=2 * i)),
        }
        for h in range(headings)
        for i, text in enumerate(texts)
    ]
    pairs = [
        {
            "long": i,
            "short": i + 1,
            "residual_percent": float(100 * (log[i + 1] - log[i])),
            "u_percent": 0.05,
        }
        for _ in range(headings)
        for i in range(len(off) - 1)
    ]
    table = {"quality": {"frames": frames, "neighbours": pairs}}
    return Sidecar.from_table(table, Path("20270320T120000Z.json"))


@pytest.mark.analytic
def test_light_that_changes_is_not_the_shutter() -> None:
    rng = np.random.default_rng(1)
    rates = rng.permutation(
        np.linspace(-4e-3, 4e-3, 15)
    )  # up to 3 % over a bracket of eight seconds
    found = shutter.fit([shutter.readings_of(quality(OFF, rate)) for rate in rates], profile())
    assert relative(np.array([t.true_s for t in found.times])) == pytest.approx(
        np.ones(5), abs=1e-3
    )
    assert found.brackets == (15,) * 5
    # What all brackets' light did alike cannot be told from the shutter: the uncertainty says so.
    rates = rng.normal(0.0, 4e-3, 15)
    found = shutter.fit([shutter.readings_of(quality(OFF, rate)) for rate in rates], profile())
    u = np.array([t.u_rel for t in found.times])
    off = np.array([t.true_s for t in found.times]) / np.array(list(TRUE_S.values()))
    assert (
        np.all(np.abs(np.log(off) - np.average(np.log(off), weights=1 / u**2)) < 3 * u)
        and u.max() < 0.02
    )


@pytest.mark.analytic
def test_two_headings_are_told_apart_and_filters_left_out() -> None:
    assert len(shutter.readings_of(quality(OFF, headings=2))) == 8
    found = shutter.readings_of(quality(OFF, nd="ND4"))
    assert len(found) == 3 and all(1 / 1000 not in r.pair for r in found)
    lame = quality(OFF, headings=2)
    # the second heading's frames do not overlap: or was it the first?
    report = structs.replace(lame.report, neighbours=lame.report.neighbours[:4])
    lame = structs.replace(lame, report=report)
    assert shutter.readings_of(lame) == []


@pytest.mark.slow
@pytest.mark.contract
def test_sidecars_that_are_none_are_passed_over(session: Session, tmp_path: Path) -> None:
    digest = sha256(session.root.parent / "small.toml")
    whole = json.loads(next(session.panoramas.glob("*Z.json")).read_text())
    broken: list[object] = [[], {}, {"profile": 3}]
    for key, value in (
        ("correction", 0.0),
        ("correction", -1.0),
        ("exposure", "1/0 f/4 ISO100"),
        ("t_utc", "noon"),
    ):
        frames = [{**f, key: value} for f in whole["quality"]["frames"]]
        broken.append({**whole, "quality": {**whole["quality"], "frames": frames}})
    broken.append(
        {**whole, "quality": {**whole["quality"], "frames": whole["quality"]["frames"][:2]}}
    )
    other = Session(tmp_path)
    other.panoramas.mkdir()
    for number, table in enumerate(broken):
        (other.panoramas / f"{number}Z.json").write_text(json.dumps(table), encoding="utf-8")
    with pytest.raises(NotEnoughDataError, match="merged brackets with overlapping frames: 0"):
        shutter.from_session(other, digest)


@pytest.mark.contract
def test_brackets_that_disagree_and_times_that_are_right_are_refused() -> None:
    rng = np.random.default_rng(2)
    wild = [
        shutter.readings_of(quality(OFF * np.exp(0.05 * rng.standard_normal(5)))) for _ in range(12)
    ]
    with pytest.raises(
        NotEnoughDataError, match=r"the ratio varies by .* light or the shutter is unsteady"
    ):
        shutter.fit(wild, profile())
    right = [shutter.readings_of(quality(np.exp(5e-4 * rng.standard_normal(5)))) for _ in range(12)]
    with pytest.raises(NotEnoughDataError, match=r"times as assumed .*keep the profile"):
        shutter.fit(right, profile())


@pytest.mark.contract
def test_times_out_of_reach_keep_what_the_profile_says() -> None:
    brackets = [shutter.readings_of(quality(OFF)) for _ in range(6)]
    short = [[r for r in b if 1 / 1000 not in r.pair] if i else b for i, b in enumerate(brackets)]
    found = shutter.fit(short, profile())
    assert len(found.times) == 4 and "both times: 1, needed: 5" in found.left_out[0]
    known = shutter.with_times(profile(), found)
    assert [t.nominal_s for t in known] == [t.nominal_s for t in found.times]
