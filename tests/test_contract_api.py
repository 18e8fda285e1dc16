"""Contract: the names of the Python API, that `import fieldlum` is light, and that examples run."""

import inspect
import json
import os
import pkgutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from learning_room import dataset

import fieldlum
from fieldlum.core.errors import InputError
from fieldlum.year.glare.sources import view_azimuths_deg
from fieldlum.year.predict.annual import dataset_of
from fieldlum.year.predict.hour_blocks import map_coordinates

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[1]
NAMES = (
    "FieldlumError",
    "Panorama",
    "SunSource",
    "__version__",
    "evaluate_glare",
    "fit",
    "light_at",
    "load_camera_profile",
    "load_model",
    "load_pairs",
    "load_site",
    "merge_frames",
    "open_session",
    "plan_captures",
    "predict_year",
    "read_panorama",
    "read_weather",
    "write_panorama",
)
FUNCTIONS = [name for name in NAMES if name[0].islower()]
OFFICE = ROOT / "capture_plans" / "seattle-office.toml"
MASKED = np.ma.masked_array([800.0], [True])
GREY = fieldlum.Panorama(np.ones((4, 8)), 180.0)


@pytest.mark.contract
def test_exported_names() -> None:
    from fieldlum import api

    assert tuple(fieldlum.__all__) == NAMES
    assert tuple(dir(fieldlum)) == NAMES
    modules = {module.name for module in pkgutil.iter_modules(api.__path__)}
    assert {n for n in vars(api) if n[0] != "_"} - modules - {"annotations"} == set(NAMES) - {
        "__version__"
    }
    assert all(hasattr(fieldlum, name) for name in NAMES)
    with pytest.raises(AttributeError, match="no attribute 'merge_frame'"):
        fieldlum.merge_frame  # type: ignore[attr-defined] # noqa: B018


@pytest.mark.contract
def test_no_name_hides_a_module() -> None:
    """`import fieldlum.plan` would replace a function `fieldlum.plan`."""
    modules = {module.name for module in pkgutil.iter_modules(fieldlum.__path__)}
    assert not modules & set(NAMES)


@pytest.mark.contract
@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_are_complete(name: str) -> None:
    function = getattr(fieldlum, name)
    text = inspect.getdoc(function) or ""
    for section in ("Parameters", "Raises", "Examples"):
        assert f"{section}\n{'-' * len(section)}\n" in text, f"{name} has no {section}"
    assert name in text.split("Examples\n")[1], f"the example of {name} does not call it"
    for parameter in inspect.signature(function).parameters:
        assert parameter in text, f"{name} does not describe {parameter}"
    assert name in (ROOT / "docs" / "python.md").read_text(encoding="utf-8")


@pytest.mark.contract
def test_import_is_light() -> None:
    code = (
        "import sys, fieldlum; assert dir(fieldlum)\n"
        "print([m for m in ('numpy', 'torch', 'fieldlum.api') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.strip() == "[]", answer.stderr


@pytest.mark.contract
def test_masked_pixels_have_no_uncertainty(tmp_path: Path) -> None:
    """They were read back with the values under the mask."""
    maps = np.full((16, 32), 100.0)
    masked = np.ma.masked_greater(np.tile(np.linspace(1.0, 9.0, 32), (16, 1)), 5.0)
    fieldlum.write_panorama(tmp_path / "a.exr", fieldlum.Panorama(maps, 0.0, u_cdm2=masked))
    again = fieldlum.read_panorama(tmp_path / "a.exr").u_cdm2
    assert again is not None
    np.testing.assert_array_equal(np.isnan(again), masked.mask)


@pytest.mark.contract
def test_the_hour_before_sunrise_may_have_some_beam() -> None:
    """Means of an hour: at its middle the sun is 2 degrees below the horizon."""
    light = fieldlum.light_at("2027-06-21T11:58Z", OFFICE, [30.0], [15.0])
    assert -3.0 < light.sun_altitude_deg[0] < -1.0


@pytest.mark.contract
@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_panorama_is_written_and_read(tmp_path: Path, suffix: str) -> None:
    maps = np.geomspace(1.0, 1e4, 16 * 32, dtype=np.float32).reshape(16, 32)
    fieldlum.write_panorama(tmp_path / f"a{suffix}", fieldlum.Panorama(maps, 90.0))
    again = fieldlum.read_panorama(str(tmp_path / f"a{suffix}"))
    assert again.heading_deg == 90.0
    np.testing.assert_allclose(again.luminance_cdm2, maps, rtol=0.008)  # RGBE: 8-bit mantissa


@pytest.mark.contract
def test_a_picture_of_another_suffix_or_shape_is_refused(tmp_path: Path) -> None:
    maps = np.ones((16, 32), np.float32)
    with pytest.raises(InputError, match=r"suffix '\.png'"):
        fieldlum.write_panorama(tmp_path / "a.png", fieldlum.Panorama(maps, 0.0))
    for call in (lambda p: fieldlum.write_panorama(tmp_path / "a.exr", p), fieldlum.evaluate_glare):
        with pytest.raises(InputError, match="16 x 16"):
            call(fieldlum.Panorama(maps[:, :16], 0.0))


@pytest.mark.contract
def test_glare_of_a_map_is_that_of_its_file(tmp_path: Path) -> None:
    maps = np.full((32, 64), 300.0, np.float32)
    maps[10:14, 30:34] = 2e4
    panorama = fieldlum.Panorama(maps, 180.0, sun=fieldlum.SunSource(40.0, 150.0, 5e4))
    fieldlum.write_panorama(tmp_path / "a.exr", panorama)
    in_memory = fieldlum.evaluate_glare(panorama, [180.0, 90.0])
    on_disk = fieldlum.evaluate_glare(tmp_path / "a.exr", [180.0, 90.0])
    assert in_memory["views"] == on_disk["views"]
    assert in_memory["file"] == ""


@pytest.mark.contract
@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"model": "transprot"}, "one of auto, .*; correct the value; did you mean 'transport'"),
        ({"model": None}, "one of auto, mean, nearest, transport, dense"),
        ({"patch": "foo"}, "one of absolute, gain, none"),
    ],
)
def test_an_impossible_argument_of_fit_is_named(wrong: dict[str, Any], expected: str) -> None:
    """A wrong name was a KeyError, and a wrong way to use sun patches was accepted."""
    ((name, value),) = wrong.items()
    with pytest.raises(InputError, match=f"{name}: .*{value!r}; expected {expected}"):
        fieldlum.fit(dataset(("2027-03-20",)), **wrong)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"capture_set": "9 day"}, "one of 9-day, .*did you mean '9-day'"),
        ({"weather": "a.epw"}, "a weather year; call read_weather first"),
    ],
)
def test_an_impossible_argument_of_a_plan_is_named(wrong: dict[str, Any], expected: str) -> None:
    ((name, value),) = wrong.items()
    with pytest.raises(InputError, match=f"{name}: .*{value!r}; expected {expected}"):
        fieldlum.plan_captures(OFFICE, **wrong)


@pytest.mark.slow
@pytest.mark.contract
def test_plan_captures_writes_a_session_or_nothing(tmp_path: Path) -> None:
    asked = {"year": 2027, "today": date(2027, 1, 1)}
    plan = fieldlum.plan_captures(str(OFFICE), "4-day", **asked)
    assert not any(tmp_path.iterdir())
    fieldlum.plan_captures(fieldlum.load_site(OFFICE), "4-day", out=tmp_path / "s", **asked)
    written = fieldlum.open_session(str(tmp_path / "s")).slots()
    assert [slot.id for slot in written] == [slot.id for slot in plan.slots]
    assert len(plan.slots) == 48  # docs/planning.md: the four-day set at Seattle


@pytest.mark.analytic
@pytest.mark.analytic
def test_light_at_takes_one_value_for_all_moments() -> None:
    """On 21 June in Seattle the sun culminates at 90 - 47.6 + 23.44 deg."""
    noon = datetime(2027, 6, 21, 20, 11, tzinfo=UTC)
    light = fieldlum.light_at([noon, noon], str(OFFICE), 800.0, 120.0)
    assert light.dni_wm2.tolist() == [800.0, 800.0]
    np.testing.assert_allclose(light.sun_altitude_deg, 65.84, atol=0.05)


@pytest.mark.analytic
def test_moments_are_datetimes_texts_or_a_pandas_index() -> None:
    import pandas as pd

    noon = datetime(2027, 6, 21, 20, 30, tzinfo=UTC)
    text = noon.isoformat().replace("+00:00", "Z")
    index = pd.date_range(noon, periods=2, freq="h").tz_convert("America/Los_Angeles")
    for times, count in ((noon, 1), (text, 1), ([text, noon], 2), (index, 2), ([index[0]], 1)):
        light = fieldlum.light_at(times, str(OFFICE), 800.0, 120.0)
        assert len(light) == count and light.t_utc[0] == noon


@pytest.mark.contract
@pytest.mark.parametrize("heading_deg", [180.0, 315.0, 0.0])
def test_coordinates_ascend_so_that_plots_work_with_every_heading(heading_deg: float) -> None:
    times = tuple(datetime(2027, 6, 21, hour, 30, tzinfo=UTC) for hour in (20, 21))
    coordinates = map_coordinates(times, 8, heading_deg)
    maps = xr.DataArray(np.ones((2, 8, 16)), dims=("time", "y", "x"), coords=coordinates)
    x = maps["x"].to_numpy()
    assert (np.diff(x) > 0).all() and x.mean() % 360.0 == pytest.approx(heading_deg)
    maps.isel(time=0).plot()
    azimuths = view_azimuths_deg(heading_deg, 10)
    figures = {"dgp": np.stack([azimuths, azimuths]) / 360.0}
    years = dataset_of(times, azimuths, {}, figures)
    assert (years.dgp.sel(azimuth=azimuths).to_numpy() == figures["dgp"]).all()
    years.dgp.plot()


@pytest.mark.contract
@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: fieldlum.load_model(3), "a value of type int"),
        (lambda: fieldlum.load_site(None), "a value of type NoneType"),
        (lambda: fieldlum.open_session(["a"]), "a value of type list"),
        (lambda: fieldlum.evaluate_glare(np.ones((4, 8))), "a value of type ndarray"),
        (lambda: fieldlum.merge_frames([], 3), "a value of type int"),
        (lambda: fieldlum.predict_year(OFFICE.parent, 3), "a value of type int"),
        (lambda: fieldlum.light_at(3, OFFICE, 1.0, 1.0), "a datetime with a time zone"),
        (lambda: fieldlum.light_at("noon", OFFICE, 1.0, 1.0), "'noon'"),
        (lambda: fieldlum.light_at("2027-01-01T12:00", OFFICE, 1.0, 1.0), "time zone"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", OFFICE, "x", 1.0), "dni_wm2"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", OFFICE, [1.0, 2.0], 1.0), "dni_wm2"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", OFFICE, -1.0, 1.0), "0 to 1600 W/m2"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", OFFICE, 8e4, 1.0), "0 to 1600 W/m2"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", OFFICE, MASKED, 1.0), "values nan"),
        (lambda: fieldlum.light_at("2027-06-21T08:00Z", OFFICE, 800.0, 120.0), "zone, the site"),
        (lambda: fieldlum.light_at("2027-06-21T20:30Z", OFFICE, 1500.0, 90.0), "sun at 65.5"),
        (lambda: fieldlum.light_at("2027-12-21T20:30Z", OFFICE, 90.0, 800.0), "dhi_wm2"),
        (lambda: fieldlum.light_at("2027-01-01T20:30Z", 3, 1.0, 1.0), "a value of type int"),
        (lambda: fieldlum.evaluate_glare("a.exr", ["north"]), "view_azimuths_deg"),
        (lambda: fieldlum.evaluate_glare("a.exr", 180.0), "view_azimuths_deg"),
        (lambda: fieldlum.evaluate_glare("a.exr", "180"), "the text '180'"),
        (lambda: fieldlum.evaluate_glare("a.exr", [np.nan]), "not finite"),
        *(
            (partial(fieldlum.evaluate_glare, replace(GREY, **wrong)), named)
            for wrong, named in (
                ({"luminance_cdm2": [["a"]]}, "could not convert"),
                ({"luminance_cdm2": np.ones((2, 4, 3))}, r"shape \(2, 4, 3\)"),
                ({"luminance_cdm2": np.empty((0, 0))}, "shape"),
                ({"luminance_cdm2": np.ma.masked_less(np.eye(4, 8), 1.0)}, "missing .NaN."),
                ({"heading_deg": np.nan}, "heading_deg"),
                ({"heading_deg": None}, "NoneType"),
                ({"flags": np.zeros((2, 4), np.uint16)}, "flags of shape"),
                ({"flags": np.zeros((4, 8))}, "flags that are no integers"),
                ({"rgb": np.zeros((4, 8))}, "rgb of shape"),
                ({"luminance_cdm2": np.full((4, 8), np.inf)}, "infinite"),
                ({"t_utc": "2027-01-01"}, "no datetime"),
                ({"sun": (30.0, 0.0, 1e4)}, "impossible sun"),
                ({"sun": fieldlum.SunSource(30.0, 0.0, 1e4, 2.0)}, "impossible sun"),
                ({"t_utc": datetime(2027, 1, 1, tzinfo=UTC).replace(tzinfo=None)}, "time zone"),
                ({"sun": fieldlum.SunSource(95.0, 0.0, 1e4)}, "impossible sun"),
                ({"sun": fieldlum.SunSource(30.0, 0.0, -1e4)}, "impossible sun"),
            )
        ),
        (lambda: fieldlum.plan_captures(OFFICE, "9day"), "'9day'; expected one of 9-day"),
        (lambda: fieldlum.plan_captures(OFFICE, "month", start="2027-03-20"), "start"),
        (lambda: fieldlum.plan_captures(3), "a value of type int"),
        (lambda: fieldlum.fit("pairs.csv"), "fieldlum.load_pairs"),
        (lambda: fieldlum.load_pairs(3), "a value of type int"),
        (lambda: fieldlum.read_weather(3, OFFICE), "a value of type int"),
        (lambda: fieldlum.merge_frames("a.dng", "sim-fisheye"), "a.dng"),
        (lambda: fieldlum.merge_frames([3], "sim-fisheye"), "a value of type int"),
        (lambda: fieldlum.write_panorama("a.exr", np.ones((4, 8))), "Panorama"),
    ],
)
def test_a_wrong_type_is_an_error_of_fieldlum(call: Callable[[], object], named: str) -> None:
    with pytest.raises(fieldlum.FieldlumError, match=named):
        call()


@pytest.mark.contract
@pytest.mark.slow
def test_notebooks_run(tmp_path: Path) -> None:
    """Code cells in order; each is stored without outputs and writes one folder."""
    folders = []
    for book in sorted((ROOT / "examples").glob("*.ipynb")):
        cells = json.loads(book.read_text(encoding="utf-8"))["cells"]
        code = [cell for cell in cells if cell["cell_type"] == "code"]
        assert len(cells) > len(code) > 3 and not any(cell["outputs"] for cell in code)
        folders.append(tmp_path / book.stem)
        folders[-1].mkdir()
        script = "\n".join("".join(cell["source"]) for cell in code)
        (folders[-1] / "cells.py").write_text(script, encoding="utf-8")
    run = "import os, runpy, sys\nfor folder in sys.argv[1:]:\n    os.chdir(folder)\n"
    run += "    runpy.run_path('cells.py')\n    print('end')"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", run, *map(str, folders)],
        capture_output=True,
        text=True,
        env=os.environ | {"MPLBACKEND": "agg"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    printed = done.stdout.split("end\n")[:-1]
    assert len(printed) == len(folders) == 2
    assert all("view to 180.0 deg: DGP" in text for text in printed)
    for folder in folders:
        assert {path.name for path in folder.iterdir()} == {"cells.py", "notebook-output"}
