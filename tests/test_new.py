"""`fieldlum new` at a pseudo-terminal, and the drawing of a room."""

from __future__ import annotations

import os
import re
import select
import sys
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum.cli import main
from fieldlum.cli.new_command import site_text, started_profile
from fieldlum.core.records import CameraSetup, Exposure, Obstruction, Room, SiteFile, Window
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.optics.raw.writing import write_jpeg
from fieldlum.room.scene.drawing import compass_text, room_svg
from fieldlum.session.site_toml import load_site
from fieldlum.year.stage_status import next_step

MAIN = "import sys; sys.argv[0] = 'fieldlum'; from fieldlum.cli import main; main()"
ROOM = Room(
    width_m=5.0,
    depth_m=6.0,
    height_m=3.0,
    camera_x_m=1.0,
    camera_y_m=2.0,
    camera_z_m=1.2,
    wall_azimuth_deg=215.0,
    window=(Window("south", 0.5, 3.0, 0.9, 1.5, 0.8, 2), Window("east", 1.0, 1.0, 0.9, 1.2)),
)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_a_person_answers_wrongly_and_rightly(tmp_path: Path) -> None:
    """Each wrong answer is named and asked again; the file reads back; the next command is said."""
    import pty

    dialogue = [
        ("Name", 'Büro "2"'),
        ("Latitude", "147"),
        ("expected -90 to 90", "45.07 N"),
        ("Longitude", "7,69 X"),
        ("is not a valid float", "7,69 E"),
        ("Time zone", "Europe/Rom"),
        ("did you mean 'Europe/Rome'", "America/New_York"),
        ("east are positive", ""),
        ("Longitude", ""),
        ("Time zone", "Europe/Rome"),
        ("Altitude", "240"),
        ("Camera: a number", "nothing"),
        ("nothing", "fisheye"),
        ("is it", "sim-fisheye"),
        ("Azimuth", "sw"),
        ("Height of the lens", "1.2"),
        ("Headings", "-"),
    ]
    path = tmp_path / "site.toml"
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", MAIN, "new", str(path)])
    said, whole = "", ""
    for prompt, answer in dialogue:
        end = time.monotonic() + 60
        while not re.search(re.escape(prompt) + r"[^\n]*: $", said, re.DOTALL) and not (
            prompt in said and re.search(r"(: |\]: )$", said)
        ):
            assert time.monotonic() < end, (prompt, said)
            if select.select([terminal], [], [], 0.2)[0]:
                said += os.read(terminal, 4096).decode("utf-8", "replace")
        whole += said
        said = ""
        os.write(terminal, f"{answer}\n".encode())
    while True:
        try:
            data = os.read(terminal, 4096)
        except OSError:
            break
        if not data:
            break
        whole += data.decode("utf-8", "replace")
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, whole[-2000:]
    os.close(terminal)
    setup = load_site(path)
    assert (setup.site.name, setup.site.latitude_deg) == ('Büro "2"', 45.07)
    assert setup.room is None and setup.camera.heading_deg == 225.0
    assert "next: fieldlum plan" in whole


@pytest.mark.property
def test_the_text_reads_back_as_the_same_site(tmp_path: Path) -> None:
    names = ('a "b" \\ c', "ü\u202e", "tab\there")
    for name in names:
        camera = CameraSetup("sim-fisheye", 215.0, (35.0, 215.0), 1.2)
        setup = SiteFile(replace(SEATTLE, name=name), camera, ROOM)
        path = tmp_path / "s.toml"
        path.write_text(site_text(setup), encoding="utf-8")
        assert load_site(path) == setup


@pytest.mark.contract
def test_a_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text("mine", encoding="utf-8")
    shown = CliRunner().invoke(main, ["new", str(path)])
    assert shown.exit_code == 3 and path.read_text("utf-8") == "mine"


@pytest.mark.analytic
def test_the_drawing_has_windows_camera_and_north_in_their_places() -> None:
    """The wall at the bottom looks to 215; a window 0.5 m from its left end seen from inside is
    0.5 m from the drawing's right wall. The scale follows from the wall's rectangle, 5 x 6 m.
    """
    desk = Obstruction(2.0, 3.0, 0.0, 1.0, 0.5, 0.74)
    room = replace(ROOM, obstruction=(desk,))
    svg = room_svg(SiteFile(replace(SEATTLE, name="<b>"), CameraSetup("", 215.0), room))
    root = ET.fromstring(svg)

    def points(gid: str) -> np.ndarray:
        path = root.find(f".//*[@id='{gid}']//{{http://www.w3.org/2000/svg}}path")
        assert path is not None
        return np.array(re.findall(r"[-.\d]+", path.get("d", "")), float).reshape(-1, 2)

    wall, south, east = points("walls"), points("window1"), points("window2")
    low, high = wall.min(axis=0), wall.max(axis=0)
    scale = (high[0] - low[0]) / 5.0
    assert high[1] - low[1] == pytest.approx(6.0 * scale, rel=1e-3)
    assert sorted((south[:, 0] - low[0]) / scale) == pytest.approx([1.5, 4.5], abs=0.01)
    assert south[:, 1] == pytest.approx(high[1], abs=0.01)
    assert east[:, 0] == pytest.approx(high[0], abs=0.01)
    box = (points("box") - low) / scale
    assert box.min(axis=0) == pytest.approx([2.0, 2.5], abs=0.01)
    assert box.max(axis=0) == pytest.approx([3.0, 3.0], abs=0.01)
    arrow = (points("camera") - low) / scale
    # it points at the wall it faces, from 1 m and 2 m away from the lower left corner
    assert np.median(arrow[:, 0]) == pytest.approx(1.0, abs=0.05)
    assert arrow[:, 1].min() == pytest.approx(4.0, abs=0.05) and arrow[:, 1].max() > 4.4
    texts = " ".join("".join(node.itertext()) for node in root.iter())
    assert '"south" faces SW 215°' in texts and '"east" faces SE 125°' in texts
    assert compass_text(359.0) == "N 359°" and compass_text(359.9) == "N 0°"
    assert room_svg(SiteFile(SEATTLE)) == ""


@pytest.mark.contract
def test_each_stage_is_followed_by_its_next_command() -> None:
    answer = {
        "session": "s",
        "capture": {"owed": 3, "frames": 0, "done": 0},
        "merge": {"owed": 0},
        "irradiance": {"rows": 0},
        "pair": {"owed": 0, "done": 0, "usable": 0},
        "train": {"models": [], "outdated": []},
        "predict": {"years": [], "outdated": []},
        "report": {"done": False, "outdated": False},
    }
    steps = [next_step(answer)]
    for change in (
        {"capture": {"owed": 3, "frames": 9, "done": 3}},
        {"merge": {"owed": 3}},
        {"merge": {"owed": 0}, "pair": {"owed": 3, "done": 0, "usable": 0}},
        {"irradiance": {"rows": 9}},
        {
            "pair": {"owed": 0, "done": 3, "usable": 3},
            "capture": {"owed": 0, "frames": 9, "done": 3},
        },
        {"train": {"models": ["auto"], "outdated": []}},
        {"predict": {"years": ["auto"], "outdated": []}},
        {"report": {"done": True, "outdated": False}},
    ):
        answer = answer | change
        steps.append(next_step(answer))
    words = ["doctor", "capture", "merge", "import", "pair", "train", "predict", "report", "open"]
    assert [word in step for word, step in zip(words, steps, strict=True)] == [True] * 9


def _answers(*more: str) -> str:
    place = ("office", "-33.9", "18.4", "Africa/Johannesburg", "0")
    return "\n".join((*place, *more)) + "\n"


@pytest.mark.contract
def test_a_longitude_with_a_wrong_sign_can_be_corrected(tmp_path: Path) -> None:
    """Longitude and time zone contradict each other: all are asked again, with their answers."""
    path = tmp_path / "office.toml"
    place = ("Bogota", "4.7", "74.07", "America/Bogota", "", "-74.07", "", "", "2600")
    answers = "\n".join((*place, "none yet", "-", "", "-", ""))
    shown = CliRunner().invoke(main, ["new", str(path)], answers)
    assert shown.exit_code == 0 and "9.9 h from solar time" in shown.output, shown.output
    site = load_site(path).site
    assert (site.longitude_deg, site.altitude_m) == (-74.07, 2600.0)


@pytest.mark.contract
def test_no_camera_and_no_heading_yet_is_an_answer(tmp_path: Path) -> None:
    """The file says what is not known, and the site knows that its defaults are no statements."""
    path = tmp_path / "office.toml"
    shown = CliRunner().invoke(main, ["new", str(path)], _answers("none yet", "-", "", "-"))
    assert shown.exit_code == 0, shown.output
    assert load_site(path).camera.assumed == ("heading_deg", "profile")
    assert "heading_deg = ... # not known yet" in path.read_text("utf-8")


@pytest.mark.contract
def test_a_camera_is_found_by_words(tmp_path: Path) -> None:
    path = tmp_path / "office.toml"
    answers = _answers("theta z1", "30", "1.5", "-")
    shown = CliRunner().invoke(main, ["new", str(path)], answers)
    setup = load_site(path)
    assert (setup.site.name, setup.camera.heading_deg) == ("office", 30.0)
    assert setup.camera.profile == "ricoh-theta-z1-uncalibrated"
    assert shown.exit_code == 0


@pytest.mark.contract
def test_an_interrupted_dialogue_offers_its_answers(tmp_path: Path) -> None:
    path = tmp_path / "office.toml"
    shown = CliRunner().invoke(main, ["new", str(path)], _answers("theta z1"))
    assert shown.exit_code == 3 and not path.exists()
    assert "office.toml: no answer to 'Azimuth that the camera faces" in shown.output
    assert "Aborted" not in shown.output
    kept = "\n" * 6
    shown = CliRunner().invoke(main, ["new", str(path)], f"{kept}30\n1.5\n-\n")
    assert shown.exit_code == 0 and "has your answers so far" in shown.output, shown.output
    setup = load_site(path)
    assert (setup.site.name, setup.camera.heading_deg) == ("office", 30.0)
    assert setup.camera.profile == "ricoh-theta-z1-uncalibrated"
    assert [file.name for file in tmp_path.iterdir()] == ["office.toml"]


@pytest.mark.contract
def test_a_damaged_file_of_answers_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "a.toml.answers").write_text('[1, ["Name of the site"], {"a": 2}]')
    answers = "office\n47\n-122\nAmerica/Los_Angeles\n0\nnone\n-\n\n-\n"
    shown = CliRunner().invoke(main, ["new", str(tmp_path / "a.toml")], answers)
    assert shown.exit_code == 0, shown.output


@pytest.mark.contract
def test_a_wrong_sign_of_the_latitude_is_asked_again(tmp_path: Path) -> None:
    answers = "office\n33.9\n18.4\nAfrica/Johannesburg\n-33.9\n\n\n0\nnone\n-\n\n-\n"
    shown = CliRunner().invoke(main, ["new", str(tmp_path / "s.toml")], answers)
    assert "with the other sign of the latitude 12" in shown.output, shown.output
    assert shown.exit_code == 0


@pytest.mark.contract
def test_an_own_profile_has_the_size_and_camera_of_a_photo(tmp_path: Path) -> None:
    """The image circle scales with the picture; a value that another camera measured is none."""
    codes = np.zeros((1872, 2808, 3), np.uint8)
    photo, out = tmp_path / "a.jpg", tmp_path / "mine.toml"
    write_jpeg(photo, codes, Exposure(0.01, 4.0, 200.0), make="Canon", model="EOS X")
    start = "canon-5d2-8mm-f5.6"
    shown = CliRunner().invoke(main, ["new", str(out), "--camera", start, "--photo", str(photo)])
    assert shown.exit_code == 0 and "no date of calibration" in shown.output, shown.output
    assert "image circles are those of a" in shown.output
    profile = load_camera_profile(out)
    assert profile.lens[0].radius_px == pytest.approx(1768.18 / 2)
    assert (profile.camera.model, profile.camera.width_px) == ("EOS X", 2808)
    assert profile.bracket.megabytes_per_frame == round(photo.stat().st_size / 1e6, 1)
    assert (profile.bracket.f_number, profile.scale.u_rel, profile.camera.date) == (4.0, 0.5, "")
    vaguer = load_camera_profile(start)
    dim = replace(vaguer.lens[0].vignetting[0], u_rel=0.4)
    vaguer = replace(vaguer, lens=(replace(vaguer.lens[0], vignetting=(dim,)),))
    assert started_profile(vaguer, start).lens[0].vignetting[0].u_rel == 0.4
    shown = CliRunner().invoke(main, ["info", start])
    assert shown.exit_code == 0 and "camera profile" in shown.output, shown.output
    raw = ["new", str(tmp_path / "r.toml"), "--camera", "canon-eos-8mm-uncalibrated"]
    shown = CliRunner().invoke(main, [*raw, "--photo", str(photo)])
    assert shown.exit_code == 3 and "a jpeg frame; expected a raw frame" in shown.output
