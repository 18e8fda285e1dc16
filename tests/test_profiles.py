"""Strict TOML: what is misspelt, impossible or missing is said; what is right comes back the
same.
"""

import math
import re
from dataclasses import replace
from datetime import date
from importlib.resources import files
from pathlib import Path

import pytest

from fieldlum.capture.doctor import judge_age
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile
from fieldlum.optics.profiles import (
    bracket_exposures,
    find_camera_profile,
    load_camera_profile,
    save_profile,
    shipped,
    uncalibrated_text,
)
from fieldlum.session.site_toml import (
    load_site,
    site_from_table,
    site_table,
    with_paths_from,
    wrong_sign_text,
)

PLACE = {
    "name": "here",
    "latitude_deg": 47.6,
    "longitude_deg": -122.3,
    "timezone": "America/Los_Angeles",
}


def _site(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.contract
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"latitude_deg": 147.0}, r"latitude_deg = '147.0'.*<= 90.0"),
        ({"longitude_deg": 190.0}, "longitude_deg = '190.0'"),
        ({"timezone": "America/Seatle"}, "unknown time zone 'America/Seatle'"),
        ({"lattitude_deg": 1.0}, "unknown key 'lattitude_deg'; did you mean 'latitude_deg'"),
        ({"latitude_deg": "north"}, "latitude_deg = 'north', not a number"),
        ({"latitude_deg": True}, "latitude_deg = 'True', not a number"),
        ({"latitude_deg": math.nan}, "expected a finite number"),
        ({"altitude_m": 52000.0}, "altitude_m = '52000.0', expected a number <= 9000"),
        (
            {"longitude_deg": 122.3},
            "122.3 with timezone America/Los_Angeles, whose clock is 7.8 h from solar time",
        ),
        (
            {"timezone": "Europe/Berlin"},
            "9.2 h from solar time; expected at most 4 h; correct one of the two; east is positive",
        ),
    ],
)
def test_a_bad_site_is_refused_with_the_finding(change: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        site_from_table({"site": {**PLACE, **change}}, "site.toml")


@pytest.mark.contract
def test_a_site_without_a_place_says_what_is_missing() -> None:
    with pytest.raises(InputError, match="no entry 'latitude_deg'"):
        site_from_table({"site": {"name": "x", "longitude_deg": 0.0}}, "site.toml")


@pytest.mark.contract
def test_what_is_no_toml_names_the_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 2"):
        load_site(_site(tmp_path, "[site]\nname = \n"))
    with pytest.raises(InputError, match=r"gone\.toml"):
        load_site(tmp_path / "gone.toml")


@pytest.mark.contract
def test_what_windows_editors_save_is_read_or_named(tmp_path: Path) -> None:
    path, text = (
        tmp_path / "site.toml",
        '[site]\nname = "Büro"\nlatitude_deg = 1.0\nlongitude_deg = 2.0\n',
    )
    path.write_bytes(text.replace("\n", "\r").encode("utf-8-sig"))
    assert load_site(path).site.name == "Büro"
    for encoding in ("cp1252", "utf-16"):
        path.write_bytes(text.encode(encoding))
        with pytest.raises(InputError, match="is not UTF-8; expected TOML in UTF-8; save it again"):
            load_site(path)


@pytest.mark.slow
@pytest.mark.authority
def test_every_place_of_the_time_zone_data_fits_its_zone() -> None:
    lines = (files("tzdata") / "zoneinfo" / "zone.tab").read_text("utf-8").splitlines()
    for line in lines:
        if line.startswith("#"):
            continue
        _, at, zone, *_ = line.split("\t")
        found = re.fullmatch(r"([+-]\d{2})\d{2,4}([+-]\d{3})(\d{2})\d*", at)
        assert found, line
        longitude = float(found[2]) + float(found[2][0] + found[3]) / 60
        place = {
            "name": zone,
            "latitude_deg": float(found[1]),
            "longitude_deg": longitude,
            "timezone": zone,
        }
        assert site_from_table({"site": place}, zone).site.timezone == zone
    assert len(lines) > 300


@pytest.mark.contract
@pytest.mark.parametrize(
    ("camera", "room", "height"),
    [
        ("", "", 1.6),
        ("height_m = 1.2", "", 1.2),
        ("", "camera_z_m = 1.2", 1.2),
        ("height_m = 1.2", "camera_z_m = 1.2", 1.2),
    ],
)
def test_the_cameras_height_counts_wherever_it_stands(
    tmp_path: Path, camera: str, room: str, height: float
) -> None:
    place = '[site]\nname = "x"\nlatitude_deg = 1.0\nlongitude_deg = 2.0\n'
    setup = load_site(_site(tmp_path, f"{place}[camera]\n{camera}\n[room]\n{room}\n"))
    assert setup.room is not None and setup.room.camera_z_m == setup.camera.height_m == height


@pytest.mark.contract
def test_two_heights_of_the_camera_are_refused(tmp_path: Path) -> None:
    place = '[site]\nname = "x"\nlatitude_deg = 1.0\nlongitude_deg = 2.0\n'
    with pytest.raises(
        InputError, match=r"height_m = 1.2 and \[room\] camera_z_m = 1.6; expected one height"
    ):
        load_site(_site(tmp_path, f"{place}[camera]\nheight_m = 1.2\n[room]\ncamera_z_m = 1.6\n"))


@pytest.mark.contract
def test_only_the_site_is_required() -> None:
    setup = site_from_table({"site": PLACE}, "x")
    assert setup.room is None and setup.camera.heading_deg == 180.0


@pytest.mark.property
@pytest.mark.parametrize(
    "path", sorted(shipped("capture_plans").glob("*.toml")), ids=lambda p: p.stem
)
def test_every_shipped_site_loads_and_round_trips(path: Path) -> None:
    setup = load_site(path)
    assert site_from_table(site_table(setup), "again") == setup


@pytest.mark.property
@pytest.mark.parametrize(
    "path",
    sorted(p for p in shipped("calibration").glob("*.toml") if "[camera]" in p.read_text("utf-8")),
    ids=lambda p: p.stem,
)
def test_every_shipped_camera_loads_and_round_trips(path: Path, tmp_path: Path) -> None:
    profile = load_camera_profile(path)
    assert bracket_exposures(profile.bracket)
    save_profile(tmp_path / "copy.toml", profile)
    assert load_camera_profile(tmp_path / "copy.toml") == profile


@pytest.mark.contract
def test_a_date_alone_is_no_calibration() -> None:
    """`calibrate lens` sets the date; the scale is still a guess, and doctor must not say ok."""
    start = load_camera_profile("canon-eos-8mm-uncalibrated")
    assert "no date of calibration: standard uncertainties are scale 50 %" in (
        uncalibrated_text(start)
    )
    dated = replace(start, camera=replace(start.camera, date="2027-01-01"))
    assert (
        "not calibrated: standard uncertainties are scale 50 %, colour 20 %, vignetting 15 %"
        in (uncalibrated_text(dated))
    )
    assert judge_age(dated, date(2027, 2, 1)).verdict == "warn"
    for name in ("canon-5d2-8mm-f5.6", "sim-fisheye"):
        assert uncalibrated_text(load_camera_profile(name)) == ""


@pytest.mark.contract
@pytest.mark.parametrize("own", ["office", "home"])
def test_an_own_profile_is_found_from_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    """A service starts capture in another folder, where another profile may have the same name."""
    profile = load_camera_profile("sim-fisheye")
    (tmp_path / "office" / "session").mkdir(parents=True)
    (tmp_path / "home").mkdir()
    save_profile(tmp_path / "office" / "mine.toml", profile)
    (tmp_path / "office" / "room.rad").touch()
    if own == "home":
        other = replace(profile, scale=replace(profile.scale, k=2.0))
        save_profile(tmp_path / "home" / "mine.toml", other)
    site = Site("office", 4.7, -74.1, "America/Bogota")
    setup = SiteFile(site, CameraSetup("mine.toml"), Room(kind="radiance", file="room.rad"))
    monkeypatch.chdir(tmp_path / "home")
    found = with_paths_from(setup, Path("../office/session"))
    assert load_camera_profile(found.camera.profile) == profile
    assert found.room and Path(found.room.file).is_file()
    monkeypatch.chdir(tmp_path / "office")
    assert with_paths_from(setup, Path("session")) == setup


@pytest.mark.contract
def test_a_misspelt_profile_key_is_refused(tmp_path: Path) -> None:
    text = find_camera_profile("").read_text("utf-8").replace("gain_e_per_dn", "gian_e_per_dn")
    path = tmp_path / "camera.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="did you mean 'gain_e_per_dn'"):
        load_camera_profile(path)


@pytest.mark.contract
def test_an_unknown_profile_lists_what_there_is() -> None:
    with pytest.raises(InputError, match="sim-dual-fisheye"):
        find_camera_profile("nikon-z99")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("line", "new", "said"),
    [
        (
            'mapping = "equisolid"',
            'mapping = "polynomial"\ncoefficients = [2.0, -1.5]',
            "rises up to the edge",
        ),
        (
            'mapping = "equisolid"',
            'mapping = "polynomial"\ncoefficients = [0.8]',
            "with the sum 0.8; expected coefficients",
        ),
        ('mapping = "equisolid"', 'mapping = "polynomial"', "no coefficients"),
        ("read_noise_e = ", "read_noise_e = -", "read_noise_e"),
        ("u_rel = 0.002", "u_rel = -0.002", "u_rel = '-0.002', expected a number"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(tmp_path: Path, line: str, new: str, said: str) -> None:
    """A lens that folds back or ends before its edge would put light where none came
    from.
    """
    text = find_camera_profile("sim-fisheye").read_text(encoding="utf-8")
    assert line in text
    (tmp_path / "odd.toml").write_text(text.replace(line, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=said):
        load_camera_profile(tmp_path / "odd.toml")


@pytest.mark.contract
def test_a_site_without_heading_and_camera_is_planned_and_says_so(tmp_path: Path) -> None:
    """Plan, sheet and doctor name each default that turns the answer; sizes are unknown."""
    from datetime import UTC, date, datetime

    from fieldlum.capture.doctor import check_disk, check_profile
    from fieldlum.plan import Request, run, sentences, summary, write_sheets

    path = tmp_path / "s.toml"
    text = (
        '[site]\nname = "s"\nlatitude_deg = 47.6\nlongitude_deg = -122.3\n'
        'timezone = "America/Los_Angeles"\n'
    )
    path.write_text(text, encoding="utf-8")
    session, made = run(load_site(path), Request("4-day", date(2027, 1, 1)), tmp_path / "p")
    assert "no heading" in made.warnings[0] and "no camera" in made.warnings[1]
    shown = "\n".join(sentences(summary(session, made)))
    assert "the size of the files is unknown" in shown and "GB" not in shown
    sheet = write_sheets(session, None, made.warnings).read_text("utf-8")
    assert sheet.count("no heading of the camera") == 1 + 4  # once a sheet
    assert 'id="view"' not in sheet
    warned = [f.text for f in check_profile(session, date(2027, 1, 1)) if f.verdict == "warn"]
    assert warned[:2] == list(made.warnings[:2])
    assert not any(f.what == "profile" for f in check_profile(session, date(2027, 1, 1)))
    disk = check_disk(session, datetime(2027, 1, 1, tzinfo=UTC), 10**9)
    assert disk.verdict == "warn" and "is unknown" in disk.text
    path.write_text(text + "[camera]\nheading_deg = 90\nprofile = 'sim-fisheye'\n", "utf-8")
    assert load_site(path).camera.assumed == ()


@pytest.mark.authority
def test_signs_are_checked_by_the_place_of_the_time_zone(tmp_path: Path) -> None:
    """zone.tab of tzdata: Cape Town's zone is in the south and east; Leticia is Bogota's."""
    for lat, lon, zone, wrong in (
        (-33.9, 18.4, "Africa/Johannesburg", ""),
        (33.9, 18.4, "Africa/Johannesburg", "sign of the latitude"),
        (-33.9, -18.4, "Africa/Johannesburg", "sign of the longitude"),
        (47.6, 122.3, "America/Los_Angeles", "sign of the longitude"),
        (9.1, 38.7, "Europe/Lisbon", "exchanged"),
        (-9.1, 38.7, "Europe/Lisbon", "exchanged"),
        (-4.2, -69.9, "America/Bogota", ""),
        (5.5, 95.3, "Asia/Jakarta", ""),
        (39.5, 76.0, "Asia/Shanghai", ""),
        (45.0, 100.0, "UTC", ""),
    ):
        text = wrong_sign_text(Site("s", lat, lon, zone))
        assert (wrong in text) if wrong else not text, (lat, lon, zone, text)
    path = tmp_path / "s.toml"
    place = 'latitude_deg = 33.9\nlongitude_deg = 18.4\ntimezone = "Africa/Johannesburg"\n'
    path.write_text(f'[site]\nname = "s"\n{place}', encoding="utf-8")
    with pytest.raises(InputError, match="other sign of the latitude"):
        load_site(path)
    right = place.replace("33.9", "-33.9")
    path.write_text(f'[site]\nname = "s"\n{right}[camera]\nheading_deg = 2250\n', encoding="utf-8")
    with pytest.raises(InputError, match="heading_deg = '2250'"):
        load_site(path)
