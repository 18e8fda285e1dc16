"""Calibration: the choice of an order, the profile that is written, and tables of readings."""

from datetime import date
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import PROFILE
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.calibrate import (
    fit_steps,
    save_calibration,
)
from fieldlum.calibrate.fit_steps import read_table
from fieldlum.core.errors import InputError
from fieldlum.optics.profiles import (
    Response,
    load_camera_profile,
    save_profile,
)


@pytest.mark.analytic
def test_the_smallest_of_equals_is_chosen() -> None:
    rng = np.random.default_rng(1)
    noise = rng.chisquare(1, 200)
    same = fit_steps.choose(
        "x",
        [
            ("small", 0, noise * 1.001),
            ("large", 3, noise),
        ],
    )
    assert same.index == 0 or "large" in same.line
    better = fit_steps.choose(
        "x",
        [
            ("small", 0, noise * 2),
            ("large", 3, noise),
        ],
    )
    assert better.index == 1
    shuffled = fit_steps.choose(
        "x",
        [
            ("small", 0, rng.permutation(noise)),
            ("large", 3, noise),
        ],
    )
    assert shuffled.index == 0


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None)
@given(st.lists(st.integers(0, 60), min_size=2, max_size=80))
def test_folds_hold_out_every_datum_once(groups: list[int]) -> None:
    held = np.sum(list(fit_steps.folds(np.array(groups))), axis=0)
    assert (held == 1).all()


@pytest.mark.contract
def test_profiles_keep_figures_hashes_and_reasons(tmp_path: Path) -> None:
    frame = tmp_path / "f.bin"
    frame.write_bytes(b"x")
    out = tmp_path / "new.toml"
    first = save_calibration(
        out, PROFILE, [frame], ["response: srgb"], date(2027, 1, 2), response=Response(kind="srgb")
    )
    again = save_calibration(
        out, load_camera_profile(out), [frame], ["scale: one factor"], date(2027, 1, 3)
    )
    assert load_camera_profile(out) == again and first.response.kind == "srgb"
    assert len(again.provenance.frames_sha256) == 1 and len(again.provenance.log) == 2
    assert again.camera.date == "2027-01-03" and again.provenance.log[0].startswith(
        "2027-01-02 response"
    )
    save_profile(tmp_path / "p.toml", PROFILE)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a,b\n1,0.98\n", 0.98),
        ("a;b\n1;0,98\n", 0.98),
        ("a\tb\n1\t0,98\n", 0.98),
        ("a,b,,\n1,0.98,,\n", 0.98),
    ],
)
def test_tables_are_read_as_spreadsheets_write_them(
    tmp_path: Path, text: str, value: float
) -> None:
    (tmp_path / "t.csv").write_text(text, encoding="utf-8-sig")
    assert read_table(tmp_path / "t.csv", ("a", "b")) == [{"a": 1.0, "b": value}]


@pytest.mark.contract
def test_decimal_commas_between_commas_are_no_other_number(tmp_path: Path) -> None:
    """0,98 read as 0, and 152,3 as 152, before: the rest of the line fell off the end."""
    (tmp_path / "t.csv").write_text("# by hand\n\na,b\n1,0.9\n1,0,98\n")
    with pytest.raises(
        InputError,
        match="line 5: 3 cells, because numbers have decimal commas; expected 2 cells",
    ):
        read_table(tmp_path / "t.csv", ("a", "b"))
