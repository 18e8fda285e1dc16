"""Perez skies against gendaylit, patches against Radiance's own files."""

from datetime import UTC, date, datetime

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fieldlum.core.records import Site
from fieldlum.optics.projection import altitude_azimuth_deg, direction
from fieldlum.sky import perez as sky
from fieldlum.sky.daylight import light_at

SUN_SR = 2 * np.pi * (1 - np.cos(np.radians(0.2665)))


@pytest.mark.analytic
def test_patches_analytic() -> None:
    for mf, count in ((1, 145), (4, 2305)):
        patches = sky.reinhart_patches(mf)
        assert len(patches) == count
        assert patches.solid_angles_sr.sum() == pytest.approx(2 * np.pi, rel=1e-12)
        assert np.linalg.norm(patches.directions, axis=1) == pytest.approx(1.0)
        # A uniform sky of 1 cd/m2 gives pi lx on the horizontal; patches' middles miss by their
        # curvature.

        seen = patches.solid_angles_sr @ patches.directions[:, 2]
        assert seen == pytest.approx(np.pi, rel=7e-3 / mf**2)


@pytest.mark.authority
def test_patch_order_authority(tmp_path) -> None:
    """Bins of reinhartb.cal, by Radiance's rcalc: each patch's middle falls in its own bin
    (clockwise from north).
    """
    import subprocess

    import pyradiance

    patches = sky.reinhart_patches(4)
    rays = tmp_path / "rays.txt"
    np.savetxt(rays, -patches.directions)  # reinhartb.cal takes incident directions
    cal = pyradiance.BINPATH.parent / "lib" / "reinhartb.cal"
    program = "MF=4;Dx=-$1;Dy=-$2;Dz=-$3;$1=rbin"
    command = [pyradiance.BINPATH / "rcalc", "-f", cal, "-e", program, rays]
    found = np.array(subprocess.run(command, capture_output=True, check=True).stdout.split(), float)
    assert np.array_equal(found, np.arange(2305))


def _gendaylit(when: datetime, dni: float, dhi: float) -> tuple[np.ndarray, float]:
    """The ten arguments of perezlum, and the sun's radiance."""
    import pyradiance

    text = pyradiance.gendaylit(
        dt=when, latitude=47.6, longitude=122.3, timezone=120, dirnorm=dni, diffhor=dhi
    ).decode()
    lines = [line for line in text.splitlines() if line.strip()]
    radiance = [float(line.split()[1]) for line in lines if line.startswith("3 ")]
    return np.array(lines[-1].split()[1:], float), radiance[0] if radiance else 0.0


@pytest.mark.slow
@pytest.mark.authority
def test_coefficients_authority_gendaylit() -> None:
    """gendaylit 2.5 over hours of the year, clear to overcast: it prints four digits, hence
    6e-4.
    """
    rng = np.random.default_rng(1)
    checked = 0
    for _ in range(120):
        month, day, minute = (
            int(rng.integers(1, 13)),
            int(rng.integers(1, 29)),
            int(rng.integers(360, 1080)),
        )
        when = datetime(2001, month, day, minute // 60, minute % 60, tzinfo=UTC)
        dni, dhi = (rng.random() > 0.3) * rng.uniform(1, 900), rng.uniform(2, 350)
        args, radiance = _gendaylit(when, dni, dhi)
        if args[0] == 0:  # the sun is down, or outside the model
            continue
        altitude = np.degrees(np.arcsin(args[9]))
        made = sky.perez_coefficients(
            dni, dhi, altitude, date(2001, month, day).timetuple().tm_yday
        )
        assert made.norm_cdm2[0] / 179 == pytest.approx(args[0], rel=6e-4)
        assert made.ground_cdm2[0] / 179 == pytest.approx(args[1], rel=1e-3)
        assert made.shape[0] == pytest.approx(
            args[2:7], rel=1e-4, abs=1e-4
        )  # the sun has six digits
        assert made.direct_lx[0] / 179 / SUN_SR == pytest.approx(radiance, rel=6e-4)
        checked += 1
    assert checked > 80


@pytest.mark.authority
def test_luminance_authority_perezlum() -> None:
    """A sky through rtrace with perezlum.cal, in directions above and below the horizon
    (RGBE-free float output).
    """
    import tempfile
    from pathlib import Path

    import pyradiance

    altitude, azimuth = 38.0, 200.0
    made = sky.perez_coefficients(420.0, 170.0, altitude, 80)
    rays = direction([80, 40, 12, 1, -1, -40], [10, 200, 300, 120, 0, 77])
    sun = direction(altitude, azimuth)
    numbers = [made.norm_cdm2[0] / 179, made.ground_cdm2[0] / 179, *made.shape[0], *sun]
    scene = "void brightfunc skyfunc\n2 skybright perezlum.cal\n0\n10 " + " ".join(
        f"{x:.9g}" for x in numbers
    )
    scene += "\nskyfunc glow g\n0\n0\n4 1 1 1 0\ng source s\n0\n0\n4 0 0 1 360\n"
    with tempfile.TemporaryDirectory() as folder:
        rad = Path(folder) / "sky.rad"
        rad.write_text(scene)
        octree = Path(folder) / "sky.oct"
        octree.write_bytes(pyradiance.oconv(str(rad)))
        origin = np.zeros_like(rays)
        stream = np.concatenate((origin, rays), axis=1).astype("<f4").tobytes()
        answer = pyradiance.rtrace(
            stream, str(octree), header=False, inform="f", outform="f", params=["-ab", "0"]
        )
    found = 179 * np.frombuffer(answer, "<f4").reshape(-1, 3)[:, 0]
    assert sky.perez_luminance(made, sun, rays)[0] == pytest.approx(found, rel=1e-4)


@pytest.mark.authority
def test_efficacy_is_about_93_lm_per_w() -> None:
    """Littlefair 1988 and Perez 1990 put beam sunlight between 90 and 110 lm/W; low
    suns are redder.
    """
    high = sky.perez_coefficients(800.0, 100.0, 50.0, 172).direct_lx[0] / 800
    low = sky.perez_coefficients(200.0, 40.0, 4.0, 172).direct_lx[0] / 200
    assert 95 < high < 112
    assert low < 70


@pytest.mark.analytic
def test_days_from_times() -> None:
    when = [datetime(2027, 3, 21, 20, tzinfo=UTC), datetime(2027, 12, 31, 20, tzinfo=UTC)]
    light = light_at(when, Site("place", 45.0, 8.0), np.full(2, 300.0), np.full(2, 100.0))
    assert light.day_of_year.tolist() == [80, 365]


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@example(
    6.0, 2.0, 41.0, 1.0
)  # more beam than so thin a sky can have: Perez's formula turns negative there
@given(st.floats(0, 1100), st.floats(0, 700), st.floats(-5, 90), st.floats(1, 365))
def test_every_sky_is_finite_and_holds_its_light(
    dni: float, dhi: float, altitude: float, day: float
) -> None:
    """No weather gives a negative or infinite sky, and patches add up to the diffuse
    illuminance within the error of gendaylit's own rule of 145 points (worst with a bright
    circumsolar sky at the horizon).
    """
    made = sky.perez_coefficients(dni, dhi, altitude, day)
    patches = sky.reinhart_patches()
    seen = sky.perez_luminance(made, direction(altitude, 180.0), patches.directions)
    assert np.isfinite(seen).all() and (seen >= -1e-9).all()
    assert np.isfinite(made.direct_lx).all() and made.direct_lx[0] >= 0
    if dhi > 5 and 2 < altitude < 87:
        horizontal = seen[0] @ (patches.solid_angles_sr * patches.directions[:, 2])
        assert 0.5 * made.diffuse_lx[0] < horizontal < 1.5 * made.diffuse_lx[0]


@pytest.mark.analytic
def test_a_direction_is_in_the_patch_around_it() -> None:
    """Middles of patches, and directions nearly half a row or column beside them."""
    patches = sky.reinhart_patches()
    number = np.arange(len(patches))
    assert (sky.reinhart_index(patches.directions) == number).all()
    altitude, azimuth = altitude_azimuth_deg(patches.directions)
    row_deg = 90.0 / 28.5
    for up, turn in ((0.45, 0.0), (-0.45, 0.0), (0.0, 1.3), (0.0, -1.3)):
        beside = direction(altitude[:120] + up * row_deg, azimuth[:120] + turn)
        assert (sky.reinhart_index(beside) == number[:120]).all()
