"""Sky pictures: the file keeps luminance, gaps and directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.projection import equirect_rays
from fieldlum.sky.sky_view.picture import (
    SkyGrid,
    SkyPicture,
    cut_panorama,
    read_sky_picture,
    write_sky_picture,
)

pytestmark = pytest.mark.analytic


def test_a_picture_is_read_as_it_was_written(tmp_path: Path) -> None:
    """Luminance returns to 0.04 %, from a dark leaf to the sun's disc; a gap remains NaN."""
    light = np.array([[0.3, 2e3, 1.6e9], [np.nan, 0.0, 17.0]], np.float32)
    clipped = np.array([[False, False, True], [False, True, False]])
    grid = SkyGrid(
        first_altitude_deg=40.05,
        first_azimuth_deg=-12.3,
        step_deg=0.05,
        heading_deg=193.0,
        height=2,
        width=3,
    )
    write_sky_picture(tmp_path / "a.sky.npz", SkyPicture(light, clipped, grid, 12.5))
    back = read_sky_picture(tmp_path / "a.sky.npz")
    assert back.grid == grid and back.dark_cdm2 == 12.5
    assert (back.clipped == clipped).all()
    np.testing.assert_allclose(back.luminance_cdm2, np.where(light == 0.0, 0.01, light), rtol=4e-4)


def test_another_file_is_refused(tmp_path: Path) -> None:
    """The message names the file and the next step."""
    path = tmp_path / "b.sky.npz"
    path.write_bytes(b"no npz")
    with pytest.raises(InputError, match=r"b\.sky\.npz.*merge the bracket again"):
        read_sky_picture(path)


def test_a_cut_panorama_keeps_directions_and_flags() -> None:
    """Each pixel of the cut has the direction of the panorama; unseen pixels are NaN."""
    light = np.arange(32.0 * 16).reshape(16, 32)
    flags = np.zeros((16, 32), np.uint16)
    flags[0, 0], flags[1, 1] = Flag.OUTSIDE_LENS, Flag.CLIPPED_HIGH
    cut = cut_panorama(Panorama(light, 200.0, flags=flags))
    assert cut.grid.height == 9
    np.testing.assert_allclose(cut.grid.rays(), equirect_rays(16, 32, 200.0)[:9], atol=1e-12)
    row, column = cut.grid.pixels(cut.grid.rays())
    np.testing.assert_allclose(row, np.arange(9)[:, None] + 0.5 + np.zeros(32), atol=1e-9)
    np.testing.assert_allclose(column, np.arange(32)[None, :] + 0.5 + np.zeros((9, 1)), atol=1e-9)
    assert np.isnan(cut.luminance_cdm2[0, 0])
    assert cut.clipped.sum() == 1
    assert cut.clipped[1, 1]
