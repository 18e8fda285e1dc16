"""Products of direction vectors: what they are, and that a row does not depend on its company."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from places import SEATTLE

from fieldlum.room.scene.box_room import turned
from fieldlum.sky.daylight import light_at
from fieldlum.sky.perez import cosines, reinhart_patches

RNG = np.random.default_rng(7)
VECTORS = RNG.normal(size=(40, 3))


@pytest.mark.analytic
def test_products_are_the_matrix_products() -> None:
    assert cosines(VECTORS, VECTORS[:7]) == pytest.approx(VECTORS @ VECTORS[:7].T, rel=1e-12)
    matrix = np.arange(9.0).reshape(3, 3)
    assert turned(matrix, VECTORS) == pytest.approx(VECTORS @ matrix.T, rel=1e-12)
    assert turned(matrix, VECTORS[0]) == pytest.approx(matrix @ VECTORS[0], rel=1e-12)


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_the_sky_of_an_hour_does_not_depend_on_the_other_hours() -> None:
    start = datetime(2027, 6, 21, 11, 30, tzinfo=UTC)
    times = [start + timedelta(days=11.3 * k, minutes=17 * k) for k in range(32)]
    dni, dhi = RNG.uniform(0, 900, 32), RNG.uniform(10, 400, 32)
    site = SEATTLE
    directions = reinhart_patches().directions[:333]
    together = light_at(times, site, dni, dhi)
    sky = together.sky_at(directions)
    for k, t in enumerate(times):
        alone = light_at([t], site, dni[k : k + 1], dhi[k : k + 1])
        assert np.array_equal(alone.sky_at(directions)[0], sky[k])
        assert alone.direct_lx[0] == together.direct_lx[k]
