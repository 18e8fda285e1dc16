"""`fieldlum view`: regions, picture and page, the page in a real browser."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.records import Panorama
from fieldlum.optics.images import write_panorama, write_radiance_hdr
from fieldlum.report.view import (
    parse_region,
    read_measured_picture,
    region_statistics,
    write_page,
)

VIEW = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"
BROWSER = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)


@pytest.fixture
def fisheye(tmp_path: Path) -> Path:
    pixels = np.full((60, 60), 100.0)
    pixels[20:30, 30:45] = 5000.0
    write_radiance_hdr(tmp_path / "a.hdr", pixels, view=VIEW)
    return tmp_path / "a.hdr"


@pytest.mark.contract
@pytest.mark.parametrize(
    "text", ["rect:10,20,0,50", "rect:10,20,50,-5", "circle:1,2,0", "cone:1,2,-3"]
)
def test_a_region_without_size_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="its size must be above 0"):
        parse_region(text)


@pytest.mark.analytic
def test_statistics_of_regions(fisheye: Path) -> None:
    """Analytic: a cone of 10 degrees has 2 pi (1 - cos 10) sr; a rectangle half in the window."""
    picture = read_measured_picture(fisheye)
    cone = region_statistics(parse_region("cone:180,-40,10"), picture)
    expected = 2 * np.pi * (1 - np.cos(np.radians(10)))
    assert cone["solid_angle_sr"] == pytest.approx(expected, rel=0.1)
    assert cone["mean_cdm2"] == cone["max_cdm2"] == pytest.approx(100.0, rel=0.01)
    half = region_statistics(parse_region("rect:35,28,4,4"), picture)
    assert half["pixels"] == 16
    assert half["mean_cdm2"] == pytest.approx(2550.0, rel=0.02)
    assert half["median_cdm2"] == pytest.approx(2550.0, rel=0.02)
    circle = region_statistics(parse_region("circle:37.5,25,3"), picture)
    assert circle["min_cdm2"] == circle["max_cdm2"] == pytest.approx(5000.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_writes_png_page_and_csv(fisheye: Path, tmp_path: Path) -> None:
    panorama = tmp_path / "p.exr"
    pixels = np.full((20, 40), 300.0, np.float32)
    write_panorama(panorama, Panorama(pixels, 180.0, 0.05 * pixels))
    table = tmp_path / "r.csv"
    for name in ("v.png", "v.html"):
        options = ["--out", str(tmp_path / name), "--region", "cone:180,0,20", "--csv", str(table)]
        files = [str(fisheye), str(panorama), *(["--force"] if table.exists() else [])]
        done = CliRunner().invoke(main, ["view", *files, *options])
        assert done.exit_code == 0, done.output
        assert (tmp_path / name).stat().st_size > 5000
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == ["a.hdr", "p.exr"]
    assert float(rows[1]["mean_cdm2"]) == pytest.approx(300.0)


@pytest.mark.slow
@pytest.mark.contract
def test_bad_regions_and_files_are_named(fisheye: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["view", str(fisheye), "--region", "rect:1,2"])
    assert done.exit_code == 2 and "circle:x,y,r" in done.output
    (tmp_path / "bad.hdr").write_text("no", encoding="ascii")
    out = tmp_path / "o.png"
    done = CliRunner().invoke(
        main, ["view", str(tmp_path / "bad.hdr"), str(fisheye), "--out", str(out)]
    )
    assert done.exit_code == 3 and out.is_file() and "bad.hdr" in done.stderr


DRIVE = """<script>
ready.then(() => {
  const p = DATA.pictures[0], box = p.over.getBoundingClientRect();
  const at = (x, y) => ({clientX: box.left + (x + .5) / p.width * box.width,
    clientY: box.top + (y + .5) / p.height * box.height, pointerId: 1, pointerType: "mouse",
    bubbles: true});
  const fire = (name, x, y) => p.over.dispatchEvent(new PointerEvent(name, at(x, y)));
  fire("pointermove", 35, 25); document.body.dataset.hover = p.reading.textContent;
  fire("pointerdown", 35, 28); fire("pointermove", 38, 31); fire("pointerup", 38, 31);
  const key = name =>
    p.over.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
  p.cross = [2, 30];
  key("ArrowRight"); document.body.dataset.keyed = p.cross.join(",");
  key("Enter"); for (let i = 0; i < 3; i++) { key("ArrowRight"); key("ArrowDown"); } key("Enter");
  document.body.dataset.rows = byId("rows").children.length;
  document.body.dataset.wide = document.documentElement.scrollWidth > innerWidth;
  document.body.dataset.fits = box.bottom <= innerHeight;
});
</script></body>"""


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
@pytest.mark.parametrize("size", ["500,800", "1366,700"])
def test_the_page_answers_to_pointer_and_keyboard_and_fits_the_window(
    fisheye: Path, tmp_path: Path, size: str
) -> None:
    picture = read_measured_picture(fisheye)
    page = tmp_path / "v.html"
    write_page(page, [picture], [])
    text = page.read_text(encoding="utf-8")
    assert "http" not in text.replace("http-equiv", "")
    page.write_text(text.replace("</body>", DRIVE), encoding="utf-8")
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={size}"]
    command += ["--virtual-time-budget=5000", "--dump-dom", page.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    marks = dict(re.findall(r'data-(\w+)="([^"]*)"', dom))
    hover = r"(49|50)\d\d cd/m².*azimuth 19\d\.\d°, altitude 1\d\.\d°; x 35, y 25"
    assert re.search(hover, marks["hover"]), marks
    assert (marks["keyed"], marks["rows"], marks["wide"]) == ("3,30", "2", "false")
    assert marks["fits"] == "true"
    expected = region_statistics(parse_region("rect:35,28,4,4"), picture)
    first = dom[dom.index("1: rect:35,28,4,4") :]
    shown = re.findall(r"<dt>(\w+)</dt><dd>([^<]*)</dd>", first)[:6]
    keys = {"sr": "solid_angle_sr"}
    assert [name for name, _ in shown] == ["mean", "median", "sd", "min", "max", "sr"]
    for name, cell in shown:
        value = expected[keys.get(name, f"{name}_cdm2")]
        assert float(cell) == pytest.approx(float(value or 0), rel=2e-3)


@pytest.mark.contract
def test_a_folder_that_is_no_session_is_named(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["view", str(tmp_path)])
    assert done.exit_code == 3 and "session" in done.stderr, done.output


@pytest.mark.contract
def test_a_session_shows_its_latest_panorama(tmp_path: Path) -> None:
    from places import SEATTLE

    from fieldlum.cli.view_command import _latest_panorama
    from fieldlum.core.errors import NotEnoughDataError
    from fieldlum.core.records import SiteFile
    from fieldlum.session import create_session

    session = create_session(tmp_path / "s", SiteFile(SEATTLE), [], {})
    with pytest.raises(NotEnoughDataError, match="run fieldlum merge"):
        _latest_panorama(session.root)
    session.panoramas.mkdir()
    for name in ("20270320T153000Z", "20270621T153000Z"):
        (session.panoramas / f"{name}.exr").touch()
    assert _latest_panorama(session.root).stem == "20270621T153000Z"
