"""Whether the intervals of DGP hold the sun's disc of rooms within 5 cm and 1 degree.

    python bench/disc_intervals.py [SITE.toml] [--rooms 100] [--length-m 0.05] [--angle-deg 1]

Takes an even map that follows the sky for every hour of a year and ten directions, draws rooms that
could be the true one, and counts how often DGP with that room's disc is in the interval that
`predict` would give (64 other rooms). The maps' own error is left out. Prints a table.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from fieldlum.bench import markdown
from fieldlum.glare import glare_directions, panorama_views, view_azimuths_deg
from fieldlum.glare.metrics import dgp_with_disc, sun_per_lx
from fieldlum.glare.standards import GlareDoubt, exceeded_in_share, protection
from fieldlum.light import light_at
from fieldlum.models.disc_in_view import drawn_discs_lx, stated_disc_lx
from fieldlum.profiles import shipped
from fieldlum.scene import stated_uncertainty
from fieldlum.simulate import weather_for
from fieldlum.site_toml import load_site

HEIGHT = 16
INDOORS = 0.02  # luminance of the even map over the sky's horizontal illuminance [sr-1]
EDGE_DGP = 0.05  # an hour and direction in which the possible rooms differ by more is at an edge


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    office = shipped("capture_plans") / "seattle-office.toml"
    parser.add_argument("site", type=Path, nargs="?", default=office)
    parser.add_argument("--rooms", type=int, default=100)
    parser.add_argument("--length-m", type=float, default=0.05)
    parser.add_argument("--angle-deg", type=float, default=1.0)
    asked = parser.parse_args()
    setup = load_site(asked.site)
    hours = weather_for(setup).daylight()
    light = light_at(hours.t_utc, setup.site, hours.dni_wm2, hours.dhi_wm2)
    heading = setup.camera.heading_deg
    views = panorama_views(HEIGHT, 2 * HEIGHT, heading, view_azimuths_deg(heading))
    level = (INDOORS * light.diffuse_lx).astype(np.float32)
    maps = np.broadcast_to(level[:, None, None], (len(light), HEIGHT, 2 * HEIGHT))
    nominal = stated_disc_lx(setup, light)
    if nominal is None or setup.room is None:
        raise SystemExit("the site needs a [room]")
    found = glare_directions(
        maps, heading, views.azimuths_deg, light.shown_sun_direction, nominal, views=views
    )
    per_lx = sun_per_lx(light.shown_sun_direction, views)
    started = time.process_time()
    discs = drawn_discs_lx(setup, light, np.random.default_rng(1))
    assert discs is not None
    drawn = dgp_with_disc(found, per_lx, discs)  # [k, n, d]
    spent = time.process_time() - started
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    low, high = np.minimum(low, found["dgp"]), np.maximum(high, found["dgp"])
    uncertainty = stated_uncertainty(setup.room, asked.length_m, asked.angle_deg)
    others = drawn_discs_lx(setup, light, np.random.default_rng(2), asked.rooms, uncertainty)
    assert others is not None
    true = dgp_with_disc(found, per_lx, others)
    inside = (true >= low - 1e-6) & (true <= high + 1e-6)
    at_edge = np.ptp(true, axis=0) > EDGE_DGP
    small = np.full_like(found["dgp"], 1e-4)
    doubt = GlareDoubt(("seen",) * len(views.azimuths_deg), found["dgp"], found["dgp"], drawn)
    rng = np.random.default_rng(3)
    year = protection(found["dgp"], small, len(light), views.azimuths_deg, rng, doubt)
    assert year.low is not None and year.high is not None
    exceeded = np.array([exceeded_in_share(one, len(light)) for one in true])
    held = (exceeded >= year.low - 1e-3) & (exceeded <= year.high + 1e-3)
    without = np.isclose(true, found["dgp"], atol=0.02)
    rows = [
        {"what": "hours and directions", "count": at_edge.size, "in": inside.mean()},
        {
            "what": "of them at an edge",
            "count": int(at_edge.sum()),
            "in": inside[:, at_edge].mean(),
        },
        {
            "what": "at an edge, stated room +- 0.02",
            "count": int(at_edge.sum()),
            "in": without[:, at_edge].mean(),
        },
        {"what": "year, EN 17037 interval", "count": held.size, "in": held.mean()},
    ]
    print(markdown(rows, {"what": "what", "count": "count", "in": "true DGP inside"}))
    print(f"{asked.rooms} rooms; drawing 64 rooms and their DGP took {spent:.1f} CPU s")


if __name__ == "__main__":
    main()
