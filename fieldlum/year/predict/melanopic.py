"""Predict melanopic EDI of a year from the colours of the captures.

Sky and sun have their own colours. The ratio of melanopic to photopic light in a view direction is
that of the sky times its share in the illuminance, plus that of the sun times the rest, times a
factor of the direction for the colours of glass and walls. The captures give sky, sun and factors;
the sun's share is that of a kernel fit to the captures' vertical illuminance, so that no map is
predicted for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.optics.images import read_panorama
from fieldlum.optics.melanopic import U_SUN, melanopic_ratio, sun_melanopic_ratio
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.sky.daylight import MIN_LX, Light, light_at
from fieldlum.sky.daylight_kernel import Facades, Features, Kernel, facades_of, light_features
from fieldlum.sky.sun import horizontal_beam
from fieldlum.year.glare.metrics import map_ev_lx
from fieldlum.year.glare.sources import panorama_views

if TYPE_CHECKING:
    from fieldlum.year.predict.hour_blocks import ModelRoom

# Where captures do not decide: the ratio of an overcast sky, what a clear sky adds, and the sun's
# over `sun_melanopic_ratio` (fits to two simulated rooms with a coloured sky), with the weight of
# _PRIOR captures.
_TYPICAL, _PRIOR = np.array([1.0, 0.25, 0.95]), 2.0


@dataclass(frozen=True, slots=True)
class MelanopicYear:
    """The ratio of melanopic to photopic light by hour and view direction, from n captures.

    kernel, captured : covariance between hours, and the captures' features; coefficients [n, d] :
    kernel(hours, captured) @ coefficients is Ev over the total light outside. weights [3] : of an
    overcast sky, of a sky's clearness, and of the sun; factors [d] : of the view directions;
    u_rel : relative standard uncertainty, by days held out and by the camera's colour and scale.
    """

    kernel: Kernel
    captured: Features
    coefficients: Floats
    weights: Floats
    factors: Floats
    u_rel: float

    def sun_shares(self, light: Light) -> Floats:
        """Return the share (0 to 1) of the sun in the light that reaches the eye, [n, d].

        It is that of the light in the same hours without their sun, by the same kernel.
        """
        shade = _without_sun(light)
        of_all, of_sky = (
            np.maximum(self.kernel(light_features(part), self.captured) @ self.coefficients, 0.0)
            * part.total_lx[:, None]
            for part in (light, shade)
        )
        share = 1.0 - of_sky / np.maximum(of_all, MIN_LX)
        return np.clip(share, 0.0, 1.0) * (light.direct_lx > 0.0)[:, None]

    def ratio(self, light: Light) -> Floats:
        """Return the ratio in n hours, [n, d]."""
        parts = _parts(light, self.sun_shares(light))
        return np.einsum("ndk,k,d->nd", parts, self.weights, self.factors)

    def figures(
        self, light: Light, views: dict[str, Floats], u_ev_rel: Floats
    ) -> dict[str, Floats]:
        """Return melanopic EDI and its standard uncertainty, by column of hourly.csv, [n, d] each.

        views : figures of the hours, with `ev_lx` and `sun_ev_lx`; u_ev_rel [n, d] : relative
        standard uncertainty of `ev_lx`.
        """
        of_map = (views["ev_lx"] - views["sun_ev_lx"]) * self.ratio(light)
        of_sun = views["sun_ev_lx"] * sun_melanopic_ratio(light.apparent_altitude_deg)[:, None]
        edi = of_map + of_sun
        u = np.hypot(np.hypot(of_map * self.u_rel, of_sun * U_SUN), edi * u_ev_rel)
        return {"melanopic_edi_lx": edi, "u_melanopic_edi_lx": u}


def _parts(light: Light, sun_share: Floats) -> Floats:
    """Return what the weights multiply, [n, d, 3]."""
    beam = horizontal_beam(light.dni_wm2, light.sun_altitude_deg)
    clear = (beam / np.maximum(beam + light.dhi_wm2, 1.0))[:, None]
    sky = 1.0 - sun_share
    sun = sun_share * sun_melanopic_ratio(light.apparent_altitude_deg)[:, None]
    return np.stack([sky, sky * clear, sun], axis=-1)


def fit_year(
    light: Light,
    photopic_lx: Floats,
    melanopic_lx: Floats,
    days: Sequence[int],
    u_colour_rel: float,
    facades: Facades,
) -> MelanopicYear:
    """Fit photopic and melanopic light at the eye in n captures and d directions.

    light : of the captures; photopic_lx, melanopic_lx : vertical illuminance without the sun's
    disc, [n, d]; days [n] : number of the day of each, for holding days out; u_colour_rel :
    relative standard uncertainty of the camera's colour and scale; facades : of the room.
    """
    day, ratio, errors = np.array(days), melanopic_lx / photopic_lx, []

    def fitted(rows: Mask) -> MelanopicYear:
        kernel, used = Kernel(facades), light[rows]
        features = light_features(used)
        # The variance of a capture is the middle one of the transport model's `NOISES`.
        covariance = kernel(features, features) + 1e-2 * np.eye(len(used))
        relative = photopic_lx[rows] / used.total_lx[:, None]
        coefficients = np.linalg.solve(covariance, relative)
        year = MelanopicYear(kernel, features, coefficients, _TYPICAL, np.ones(0), 0.0)
        weights, factors = _solve(_parts(used, year.sun_shares(used)), ratio[rows])
        return replace(year, weights=weights, factors=factors)

    for held in np.unique(day):
        rows = day != held
        if rows.any():
            errors.append(fitted(rows).ratio(light[~rows]) / ratio[~rows])
    off = np.concatenate(errors) - 1.0 if errors else np.full((1, 1), 0.1)
    u_rel = float(np.hypot(np.sqrt(np.mean(off**2)), u_colour_rel))
    return replace(fitted(np.ones(len(day), bool)), u_rel=u_rel)


def _solve(parts: Floats, ratio: Floats) -> tuple[Floats, Floats]:
    """Return the weights [3] by relative least squares, and the factors [d]."""
    rows = (parts / ratio[..., None]).reshape(-1, 3)
    pull = np.sqrt(_PRIOR * ratio.shape[1]) * np.eye(3) * np.sqrt((rows**2).mean(axis=0))
    stacked = np.concatenate([rows, pull]), np.concatenate([np.ones(len(rows)), pull @ _TYPICAL])
    weights = np.linalg.lstsq(*stacked, rcond=None)[0]
    count = len(ratio)
    off = (ratio / (parts @ weights)).mean(axis=0) - 1.0
    return weights, 1.0 + off * count / (count + _PRIOR)


def _without_sun(light: Light) -> Light:
    sky, dark = light.sky, np.zeros(len(light))
    beam = horizontal_beam(sky.direct_lx, light.sun_altitude_deg)
    ground = sky.ground_cdm2 * sky.diffuse_lx / np.maximum(sky.diffuse_lx + beam, MIN_LX)
    perez = replace(sky, direct_lx=dark, ground_cdm2=ground)
    return replace(light, dni_wm2=dark, perez=perez)


def has_colour(pairs: Path) -> bool:
    """Return whether the first picture of a pairs.csv has melanopic colour."""
    first = next((row for row in PairsFile.find(pairs).usable if row.panorama), None)
    picture = None if first is None else pairs.parent / first.panorama
    if picture is None or not picture.is_file():
        return False
    return melanopic_ratio(read_panorama(picture)) is not None


def year_of_captures(
    pairs: Path, room: ModelRoom, azimuths_deg: Floats, u_scale: float
) -> MelanopicYear:
    """Fit the ratio to the pictures of a pairs.csv, in view directions [d].

    u_scale: relative standard uncertainty of the camera's scale, which the ratio then includes.
    Raises NotEnoughDataError if no picture has melanopic colour.
    """
    views = panorama_views(room.height, room.width, room.heading_deg, azimuths_deg, room.seen)
    usable = [row for row in PairsFile.find(pairs).usable if row.panorama and not row.sun_in_map]
    # at most 80 captures are read, which limits the time
    step = -(-len(usable) // 80) if usable else 1
    rows: list[PairRow] = []
    photopic, melanopic, u_rel = [], [], 0.0
    for row in usable[::step]:
        picture = read_panorama(pairs.parent / row.panorama)
        colour = melanopic_ratio(picture)
        if colour is None:
            continue
        light = np.maximum(np.nan_to_num(picture.luminance_cdm2), 0.0)
        both = map_ev_lx(np.stack([light, light * colour[0]]), views)
        photopic.append(np.maximum(both[0], MIN_LX))
        melanopic.append(both[1])
        rows, u_rel = [*rows, row], max(u_rel, colour[1])
    if not rows:
        raise NotEnoughDataError(f"{pairs}: no picture has melanopic colour; merge them again")
    dni, dhi = (np.array([getattr(row, name) for row in rows]) for name in ("dni_wm2", "dhi_wm2"))
    light = light_at([row.t_utc for row in rows], room.setup.site, dni, dhi)
    days = [row.t_utc.toordinal() for row in rows]
    facades = facades_of(room.setup.room)
    return fit_year(
        light,
        np.array(photopic),
        np.array(melanopic),
        days,
        float(np.hypot(u_rel, u_scale)),
        facades,
    )
