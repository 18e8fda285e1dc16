"""Wrong usages of a new user: none is a traceback, and each names what was found and what to do."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny_field import make_session

from fieldlum.cli import main
from fieldlum.core.records import Exposure, Panorama
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.optics.profiles import shipped
from fieldlum.optics.raw.writing import write_jpeg

pytestmark = pytest.mark.contract

SITE = """[site]
name = "Desk"
latitude_deg = {latitude}
longitude_deg = -122.3
timezone = "America/Los_Angeles"
{more}"""
VIEW = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files of which each is wrong in one way, and a few that are right."""
    folder = tmp_path_factory.mktemp("desk")
    sites = {
        "good": (47.6, ""),
        "north": (147.6, ""),
        "sign": (-47.6, ""),
        "key": (47.6, "lattitude = 3\n"),
        "camera": (47.6, '[camera]\nprofile = "nikon-d9"\n'),
        "filter": (47.6, '[camera]\nprofile = "sim-fisheye"\nfilter = "nd9"\n'),
        "low": (47.6, "[camera]\nheight_m = -2\n"),
        "heading": (47.6, '[camera]\nheading_deg = "south"\n'),
        "wall": (
            47.6,
            '[room]\nkind = "box"\nwidth_m = 4\ndepth_m = 4\nheight_m = 3\n'
            '[[room.window]]\nwall = "up"\nleft_m = 1\nwidth_m = 1\nsill_m = 1\nheight_m = 1\n',
        ),
        "zone": (47.6, ""),
    }
    for name, (latitude, more) in sites.items():
        text = SITE.format(latitude=latitude, more=more)
        if name == "zone":
            text = text.replace("America/Los_Angeles", "Pacific")
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    (folder / "broken.toml").write_text("[site\nname = ", encoding="utf-8")
    nikon = (shipped("calibration") / "nikon-8mm-uncalibrated.toml").read_text(encoding="utf-8")
    fuji = nikon.replace("[sensor]\n", '[sensor]\ncfa = "XTRANS"\n')
    (folder / "xtrans.toml").write_text(fuji, encoding="utf-8")
    (folder / "empty").mkdir()
    (folder / "empty.csv").write_text("", encoding="utf-8")
    (folder / "text.hdr").write_text("no picture", encoding="utf-8")
    (folder / "text.exr").write_text("no picture", encoding="utf-8")
    (folder / "photo.JPG").write_text("no picture", encoding="utf-8")
    (folder / "weather.epw").write_text("LOCATION,a,b\n", encoding="utf-8")
    (folder / "sky.csv").write_text("t_utc,dni_wm2\n2027-01-01T00:30:00Z,1\n", encoding="utf-8")
    write_radiance_hdr(folder / "fish.hdr", np.full((40, 40), 100.0), view=VIEW)
    write_panorama(folder / "good.exr", Panorama(np.full((8, 16), 10.0, np.float32), 0.0))
    make_session(folder / "session")
    (folder / "body.toml").write_bytes((shipped("calibration") / "sim-fisheye.toml").read_bytes())
    write_jpeg(folder / "true.JPG", np.full((60, 90, 3), 90, np.uint8), Exposure(0.1, 5.6))
    (folder / "photos").mkdir()
    (folder / "photos" / "a.jpg").write_bytes((folder / "true.JPG").read_bytes())
    (folder / "a.pdf").write_bytes(b"%PDF-1.4")
    return folder


# Words of the command line, what the answer names, and the exit code. @ stands for the folder.
CASES = [
    ("plan", "Missing argument", 2),
    ("plan @/none.toml --set 9-day --out @/s1", "no such file or folder; expected", 3),
    ("plan @/good.toml", "--set and --out", 2),
    ("plan @/good.toml --set 9day --out @/s1", "did you mean '9-day'", 2),
    ("plan @/good.toml --set 9-day --out @/s1 --start 2027-13-01", "2027-13-01", 2),
    ("plan @/good.toml --set 9-day --out @/s1 --start tomorrow", "tomorrow: expected a date", 2),
    ("plan @/good.toml --set 9-day --count 5 --out @/s1", "--count needs", 2),
    ("plan @/good.toml --set 9-day --days 5 --out @/s1", "--days needs", 2),
    ("plan @/good.toml --set 9-day --year 2027 --start 2027-01-01 --out @/s1", "exclude", 2),
    ("plan @/good.toml --set 9-day --out @/session", "session", 3),
    ("plan @/good.toml --set 9-day --out @/good.toml", "good.toml", 3),
    ("plan @/good.toml --set 9-day --out /proc/nope", "nope", 3),
    ("plan @/good.toml --set 9-day --weather @/empty.csv --out @/s1", "empty file", 3),
    ("plan @/good.toml --set 9-day --weather @/weather.epw --out @/s1", "LOCATION,city", 3),
    ("plan @/good.toml --set 9-day --weather @/sky.csv --out @/s1", "dhi_wm2", 3),
    ("plan @/good.toml --set 9-day --weather @/text.hdr --out @/s1", "csv|columns", 3),
    ("plan @/good.toml --set 9-day --label-shift 30 --out @/s1", "--weather", 2),
    ("plan @/north.toml --set 9-day --out @/s1", "147.6.*a number <= 90", 3),
    ("plan @/sign.toml --set 9-day --out @/s1", "other sign", 3),
    ("plan @/key.toml --set 9-day --out @/s1", "lattitude", 3),
    ("plan @/camera.toml --set 9-day --out @/s1", "nikon-d9.*one of", 3),
    ("plan @/filter.toml --set 9-day --out @/s1", "nd9.*nd5", 3),
    ("plan @/heading.toml --set 9-day --out @/s1", "heading_deg", 3),
    ("plan @/wall.toml --set 9-day --out @/s1", "south", 3),
    ("plan @/zone.toml --set 9-day --out @/s1", "Europe/Rome.*did you mean 'Pacific/", 3),
    ("plan @/broken.toml --set 9-day --out @/s1", "broken.toml", 3),
    ("plan @/empty --replan", "session", 3),
    ("doctor @/empty", "session", 3),
    ("doctor @/session --camera gohoto:", "gohoto.*one of gphoto.*did you mean 'gphoto'", 4),
    ("doctor @/session --pyranometer serial:", "no port, no kind or no profile; expected", 4),
    ("capture @/session", "--camera", 2),
    ("capture @/empty --camera sim:office", "session", 3),
    ("status @/good.toml", "session", 3),
    ("status @/session --mark 2027 lamp=on", "2027", 3),
    ("import @/session @/none", "no such folder", 3),
    ("merge @/empty", "session", 3),
    ("merge --frames @/photo.JPG --camera sim-fisheye --out @/o.exr", "photo.JPG", 3),
    ("merge --frames @/none.JPG --camera sim-fisheye --out @/o.exr", "none.JPG", 3),
    ("merge --frames @/photo.JPG --camera nikon-d9 --out @/o.exr", "nikon-d9", 3),
    ("merge --frames @/photo.JPG --out @/o.exr", "--camera", 2),
    ("pair @/empty", "session", 3),
    ("train @/empty", "no session.toml", 3),
    ("train @/none", "none", 3),
    ("train @/session --model transprt", "did you mean 'transport'", 2),
    ("train @/session --budget 0", "budget", 2),
    ("predict @/empty --weather synthetic", "model", 3),
    ("predict @/none --weather synthetic", "none", 3),
    ("report @/empty", "session", 3),
    ("glare @/text.hdr", "text.hdr", 3),
    ("glare @/text.exr", "text.exr", 3),
    ("glare @/photo.JPG", "photo.JPG", 3),
    ("glare @/none.hdr", "none.hdr", 3),
    ("glare @/fish.hdr --view -vtx", "vtx; expected -vta", 3),
    ("glare @/fish.hdr --calibrate-ev -5", "-5|range", 2),
    ("view @/empty", "session", 3),
    ("view @/fish.hdr --region square:1,2", "rect:x,y,w,h", 2),
    ("view @/fish.hdr --out @/o.gif", "gif", 2),
    ("info @/xtrans.toml", "'XTRANS'; expected one of RGGB", 3),
    ("info rpi-hq", "did you mean 'rpi-hq-fisheye-uncalibrated'", 3),
    ("info @/text.exr", "text.exr", 3),
    ("new @/good.toml", "good.toml", 3),
    ("calibrate lens", "Missing|missing", 2),
    ("scene fit @/empty", "session|pairs", 3),
    ("watch @/empty", "session", 3),
    ("campaign report @/good.toml", "good.toml", 3),
    ("simulate @/good.toml --out @/s2", "room|plan|session", 3),
    # files of another kind: the answer names the kind and the file to give
    ("plan @/body.toml --set 9-day --out @/s1", "a camera profile; expected a SITE.toml", 3),
    ("plan @/session/session.toml --set 9-day --out @/s1", "session.toml of a session", 3),
    ("plan @/session --set 9-day --out @/s1", "a folder: a new plan needs a SITE.toml", 2),
    ("plan @/true.JPG --set 9-day --out @/s1", "a JPEG picture; expected a TOML", 3),
    ("plan @/good.toml --set 9-day --weather @/true.JPG --out @/s1", "JPEG picture.*EPW", 3),
    ("plan @/good.toml --set 9-day --out=", "an empty text; expected a path", 2),
    ("plan @/good.toml --replan", "this is a file; expected a session folder", 3),
    ("new @/n.toml --camera @/good.toml", "a SITE.toml; expected a camera profile", 3),
    ("new @/n.toml --photo @/true.JPG", "--camera", 2),
    ("doctor @/session/session.toml", "this is a file.*name its folder: @/session", 3),
    (
        "doctor @/session --pyranometer serial:/dev/x?kind=no",
        "the value .no.; expected one of spn1",
        4,
    ),
    ("doctor @/session --pyranometer modbus:/dev/x?kind=smp&parity=Q", "one of N, E, O", 4),
    ("doctor @/session --camera @/body.toml", "not a device URI; expected one like sim:", 4),
    ("capture @/good.toml --camera sim:office", "a file; expected a session folder", 3),
    ("capture @/session --camera sim:office?profile=@/good.toml --clock fast", "a SITE.toml", 3),
    ("capture @/session --camera sim:office?sed=3 --clock fast", "did you mean 'seed'", 4),
    ("capture @/session --camera sim:office --clock fast --every 0", "0.1", 2),
    ("log @/session", "--pyranometer", 2),
    ("import @/session", "card's folder, or a logger's file", 2),
    ("import @/session @/true.JPG", "a file, not a folder", 3),
    ("import @/session @/empty", "no raw or JPEG frames", 3),
    ("import @/session --irradiance @/good.exr", "an OpenEXR picture; expected a logger's", 3),
    ("import @/session @/photos --utc-offset 8", "8 is no UTC offset", 2),
    ("status @/session --mark 20270320T153000Z lamp=onn", "did you mean 'lamp=on'", 3),
    ("doctor @/session --pyranometer modbus:/dev/x?kind=smpp", "did you mean 'smp'", 4),
    ("bench @/session --models dens --out @/b", "did you mean 'dense'", 3),
    ("bench @/session --models mean, --out @/b", "unknown name ''; expected mean", 3),
    ("train @/session --seed -1", "-1 is not in the range 0", 2),
    ("view @/good.exr --csv @/new.csv", "--region", 2),
    ("capture @/session --camera sim:office --notify-picture", "--notify", 2),
    ("status @/session --mark 20270320T153000Z lamp", "'lamp' is not a state of a room", 3),
    ("merge @/true.JPG", "files.*need --frames", 2),
    ("merge @/session --heading 90", "--heading need --frames", 2),
    ("merge @/session --size 100x100", "twice as wide as high", 2),
    ("merge @/session --scheduler foo", "'foo'; expected local", 3),
    (
        "merge --frames @/true.JPG --camera @/good.toml --out @/o.exr",
        "a SITE.toml; expected a camera profile; name a shipped one",
        3,
    ),
    ("merge --frames @/true.JPG --camera @/true.JPG --out @/o.exr", "a JPEG picture", 3),
    ("merge --frames @/true.JPG --camera sim-fisheye --out @/o.png", "'.png'.*.exr or .hdr", 3),
    ("merge --frames @/good.exr --camera sim-fisheye --out @/o.exr", "an OpenEXR picture", 3),
    ("merge --frames @/photos --camera sim-fisheye --out @/o.exr", "JPEG frame; expected raw", 3),
    ("pair @/good.exr", "this is a file", 3),
    ("train @/good.exr --site @/good.toml", "an OpenEXR picture; expected a csv", 3),
    ("train @/sky.csv --site @/good.toml", "no column panorama", 3),
    ("train @/session --budget nan", "nan is not a finite number", 2),
    ("predict @/session --weather synthetic", "config.json: No such file", 3),
    (
        "glare @/true.JPG",
        "a JPEG picture; expected a luminance .hdr or .exr; merge photos: fieldlum merge",
        3,
    ),
    ("glare @/a.pdf", "a PDF; expected a luminance .hdr or .exr", 3),
    ("glare @/session", "no panorama to judge; run fieldlum merge", 5),
    ("glare @/good.exr --view-azimuth 4000", "4000.*not in the range", 2),
    ("glare @/good.exr --csv @/good.exr", "exists already", 3),
    ("view @/true.JPG", "a JPEG picture.*merge photos", 3),
    ("view @/session", "no panorama to view", 5),
    ("compare @/session @/good.exr", "an OpenEXR picture; expected an hourly table", 3),
    ("export @/session", "no merged map and no year; run fieldlum merge", 5),
    ("bench @/sky.csv --site @/good.toml --out @/b", "no column panorama", 3),
    ("simulate @/body.toml --out @/s2", "a camera profile; expected a SITE.toml", 3),
    ("campaign report @/body.toml", "a camera profile; expected a file with the tables", 3),
    ("info @/a.pdf", "a PDF; expected a frame", 3),
    ("calibrate lens @/true.JPG --camera @/body.toml --out @/c.toml", "or --circle", 2),
    (
        "calibrate lens @/true.JPG --circle --camera @/body.toml --out @/c.toml",
        "a frame of 90 x 60 pixels; expected 484 x 484",
        3,
    ),
    ("calibrate scale @/good.exr --camera @/body.toml --out @/c.toml", "an OpenEXR picture", 3),
    ("calibrate linearity @/photos --camera @/body.toml --out @/c.toml", "camera's raw files", 3),
    ("calibrate pixels @/empty --camera @/body.toml --out @/c.toml", "no frames in this", 3),
    ("calibrate lens @/true.JPG --chessboard 1x1 --camera @/body.toml --out @/c.toml", "3 x 3", 2),
    (
        "calibrate lens @/true.JPG --chessboard nanx6 --camera @/body.toml --out @/c.toml",
        "nanx6",
        2,
    ),
    ("permit @/good.exr", "no link; expected a link in a session", 3),
    ("demo @/session", "a session of another site; expected a new folder", 3),
    ("plan @/low.toml --set 9-day --out @/s1", "height_m = '-2'.*number > 0", 3),
    ("pack @/session @/o.zip", "--title", 2),
    (
        "pack @/session @/o.tar --title a --author b --licence MIT --publisher c --people none",
        "o.tar: the suffix '.tar'; expected a .zip",
        3,
    ),
    ("scene click @/good.exr", "this is a file", 3),
    ("watch @/session --port 70000", "65535", 2),
    ("permit @/none", "no such file or folder; expected", 3),
    ("plan @/good.toml --set month --start 20-3-2027 --out @/x", "a date.*like 2027-03-20", 2),
    ("plan @/good.toml --set month --start 2027-13-01 --out @/x", "a date.*like 2027-03-20", 2),
    ("capture @/session --camera sim:office --grace 5min", "'5min' is not a valid number", 2),
    ("simulate @/session --out @/s3 --year 2028", "a SESSION.*omit --out, --year", 2),
    ("status @/none", "no such folder; expected a session folder", 3),
    ("mrege @/session", "merge", 2),
    ("merge @/session --hieght 100", "No such option", 2),
]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no /sys")
def test_a_folder_without_permission_is_named_with_the_file_of_the_user(desk: Path) -> None:
    words = ["view", str(desk / "good.exr"), "--out", "/sys/view.png"]
    shown = CliRunner().invoke(main, words)
    assert shown.exit_code == 3 and "view: /sys/view.png: " in shown.output, shown.output
    assert "; expected a place open to you; change" in shown.output


def test_a_picture_goes_into_a_new_folder(desk: Path) -> None:
    picture = desk / "new" / "v.png"
    shown = CliRunner().invoke(main, ["view", str(desk / "good.exr"), "--out", str(picture)])
    assert shown.exit_code == 0 and picture.is_file(), shown.output


@pytest.mark.parametrize(
    "words",
    [
        "merge @/session",
        "pair @/session",
        "scene fit @/session",
        "scene click @/session",
        "train @/session",
        "bench @/session --out @/b",
        "report @/session",
        "report @/session --for assessor",
        "export @/session",
        "glare @/session",
        "view @/session",
        "compare @/session @/hours.csv",
        "pack @/session @/o.zip --title a --author b --licence MIT --publisher c --people none",
    ],
)
def test_a_stage_without_the_results_of_an_earlier_one_exits_with_5(desk: Path, words: str) -> None:
    """Not enough data: nothing that the user named is wrong. The line states what to do."""
    (desk / "hours.csv").write_text("hoy,dgp@0\n12,0.3\n13,0.3\n", encoding="utf-8")
    shown = CliRunner().invoke(main, words.replace("@/", f"{desk}/").split())
    assert shown.exit_code == 5, shown.output
    assert "; " in shown.output, shown.output


@pytest.mark.parametrize(("words", "named", "code"), CASES, ids=[case[0] for case in CASES])
def test_a_wrong_usage_is_answered_in_words(desk: Path, words: str, named: str, code: int) -> None:
    if "/proc/" in words and os.name == "nt":
        pytest.skip("no /proc here")
    shown = CliRunner().invoke(main, words.replace("@", str(desk)).split(), input="")
    assert isinstance(shown.exception, SystemExit), f"traceback: {shown.exception!r}"
    assert shown.exit_code == code, shown.output
    assert "Traceback" not in shown.output
    text = " ".join(shown.output.replace(str(desk), "@").split())
    assert re.search(named, text), text


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_while_python_imports_prints_no_traceback() -> None:
    code = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in the background
        "class Pressed:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'fieldlum.cli': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Pressed())\n"
        "from fieldlum.__main__ import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")
