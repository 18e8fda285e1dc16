"""Predict melanopic EDI of a year from the colours of the captures.

Sky and sun have their own colours. The ratio of melanopic to photopic light in a view direction is
that of the sky times its share in the illuminance, plus that of the sun times the rest, times a
factor of the direction for the colours of glass and walls. The captures give sky, sun and factors;
the sun's share is that of a kernel fit to the captures' vertical illuminance, so that no map is
predicted for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.room_states import is_lit
from fieldlum.optics.images import read_panorama
from fieldlum.optics.melanopic import (
    U_LAMP,
    U_SUN,
    U_SUN_RATIO,
    melanopic_ratio,
    sun_melanopic_ratio,
)
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.sky.daylight import MIN_LX, Light, light_at
from fieldlum.sky.daylight_kernel import Facades, Features, Kernel, facades_of, light_features
from fieldlum.sky.sun import horizontal_beam, standard_time
from fieldlum.year.glare import uncertainty_budget as budget
from fieldlum.year.glare.metrics import map_ev_lx
from fieldlum.year.glare.sources import panorama_views

if TYPE_CHECKING:
    from fieldlum.year.predict.hour_blocks import ModelRoom

# Where captures do not decide: the ratio of an overcast sky, what a clear sky adds, and the sun's
# over `sun_melanopic_ratio` (fits to two simulated rooms with a coloured sky), with the weight of
# _PRIOR captures.
_TYPICAL, _PRIOR = np.array([1.0, 0.25, 0.95]), 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MelanopicYear:
    """The ratio of melanopic to photopic light by hour and view direction, from n captures.

    kernel, captured : covariance between hours, and the captures' features; coefficients [n, d] :
    kernel(hours, captured) @ coefficients is Ev over the total light outside. weights [3] : of an
    overcast sky, of a sky's clearness, and of the sun; factors [d] : of the view directions;
    u_fit_rel : relative standard uncertainty by days held out; u_camera_rel : by each part of the
    camera's calibration.
    """

    kernel: Kernel
    captured: Features
    coefficients: Floats
    weights: Floats
    factors: Floats
    u_fit_rel: float
    u_camera_rel: Mapping[str, float]

    @property
    def u_rel(self) -> float:
        """Relative standard uncertainty of the ratio and of the camera."""
        return float(np.hypot(self.u_fit_rel, np.linalg.norm([*self.u_camera_rel.values()])))

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
        self,
        light: Light,
        views: Mapping[str, Floats],
        u_map_rel: Floats,
        drawn_ev_lx: Floats,
        unseen_lx: Floats,
    ) -> dict[str, Floats]:
        """Return melanopic EDI and its standard uncertainty, by column of hourly.csv, [n, d] each.

        views : figures of the hours, with `ev_lx` and `sun_ev_lx`; u_map_rel [n, d] : relative
        standard uncertainty of the map's part of `ev_lx`; drawn_ev_lx [m, n, d] : Ev in draws of
        the sun's disc; unseen_lx [n, d] : the most that the unseen part of the view adds to Ev.
        The further keys are what `edi_budget` needs. Hours with a lamp on have `U_LAMP` too, as
        part of the model's.
        """
        ratio, states = self.ratio(light), light.states or ("",) * len(light)
        u_lamp_rel = U_LAMP * np.array([[is_lit(text)] for text in states])
        u_map_rel = np.hypot(u_map_rel, u_lamp_rel)
        of_map = (views["ev_lx"] - views["sun_ev_lx"]) * ratio
        sun_ratio = sun_melanopic_ratio(light.apparent_altitude_deg)[:, None]
        of_sun = views["sun_ev_lx"] * sun_ratio
        drawn = ((drawn_ev_lx - views["ev_lx"]) * sun_ratio).astype(np.float32)
        unseen = unseen_lx * ratio / np.sqrt(3.0)  # rms of 0 to this, about 0
        parts = of_map * np.hypot(self.u_rel, u_map_rel), of_sun * U_SUN, unseen
        u = np.sqrt(sum(part**2 for part in parts) + (drawn**2).mean(axis=0))
        return {
            "melanopic_edi_lx": of_map + of_sun,
            "u_melanopic_edi_lx": u,
            "edi_of_map_lx": of_map,
            "edi_by_model_lx": of_map * u_map_rel,
            "edi_of_unseen_lx": unseen,
            "edi_by_disc_lx": np.moveaxis(drawn, 0, -1),  # [n, d, m]
        }


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
    u_camera_rel: Mapping[str, float],
    facades: Facades,
) -> MelanopicYear:
    """Fit photopic and melanopic light at the eye in n captures and d directions.

    light : of the captures; photopic_lx, melanopic_lx : vertical illuminance without the sun's
    disc, [n, d]; days [n] : number of the day of each, for holding days out; u_camera_rel :
    relative standard uncertainty by each part of the camera's calibration; facades : of the room.
    """
    day, ratio, errors = np.array(days), melanopic_lx / photopic_lx, []

    def fitted(rows: Mask) -> MelanopicYear:
        kernel, used = Kernel(facades), light[rows]
        features = light_features(used)
        # The variance of a capture is the middle one of the transport model's `NOISES`.
        covariance = kernel(features, features) + 1e-2 * np.eye(len(used))
        relative = photopic_lx[rows] / used.total_lx[:, None]
        coefficients = np.linalg.solve(covariance, relative)
        year = MelanopicYear(
            kernel=kernel,
            captured=features,
            coefficients=coefficients,
            weights=_TYPICAL,
            factors=np.ones(0),
            u_fit_rel=0.0,
            u_camera_rel=u_camera_rel,
        )
        weights, factors = _solve(_parts(used, year.sun_shares(used)), ratio[rows])
        return replace(year, weights=weights, factors=factors)

    for held in np.unique(day):
        rows = day != held
        if rows.any():
            errors.append(fitted(rows).ratio(light[~rows]) / ratio[~rows])
    off = np.concatenate(errors) - 1.0 if errors else np.full((1, 1), 0.1)
    return replace(fitted(np.ones(len(day), bool)), u_fit_rel=float(np.sqrt(np.mean(off**2))))


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
    pairs: Path, room: ModelRoom, azimuths_deg: Floats, u_camera_rel: Mapping[str, float]
) -> MelanopicYear:
    """Fit the ratio to the pictures of a pairs.csv, in view directions [d].

    u_camera_rel: relative standard uncertainty by each part of the camera's calibration.
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
    days, facades = [row.t_utc.toordinal() for row in rows], facades_of(room.setup.room)
    u_parts_rel = {**u_camera_rel, "melanopic weight": u_rel}
    if lit := np.mean([is_lit(row.state) for row in rows]):
        u_parts_rel["spectrum of lamps"] = float(U_LAMP * lit)
    return fit_year(light, np.array(photopic), np.array(melanopic), days, u_parts_rel, facades)


# ----------------------------------------------------------------------------------------------
# the year's figures and their uncertainty budget

BROWN_EDI_LX, BROWN_HOURS = 250.0, (6, 19)  # Brown et al., PLOS Biology 20 (2022)
WELL_EDI_LX, WELL_HOURS = (109.0, 136.0, 163.0, 250.0), (9, 13)  # WELL v2, L03
ENOUGH_HOURS = f"mEDI of {BROWN_EDI_LX:.0f} lx or more, hours 06:00 to 19:00"
ENOUGH_DAYS = tuple(f"mEDI of {limit:.0f} lx or more, days 09:00 to 13:00" for limit in WELL_EDI_LX)


@dataclass(frozen=True, slots=True)
class YearHours:
    """The n daylight hours of a number of days: `hour` of the day, and `day` from 0, [n] each.

    Both are of local standard time.
    """

    hour: Array
    day: Array
    days: int

    @classmethod
    def of(cls, t_utc: Sequence[datetime], zone: str, days: int) -> YearHours:
        """Return the hours of times; zone: IANA name; days: number of days, with dark ones."""
        local = [standard_time(t, zone) for t in t_utc]
        hour, day = np.array([(t.hour, t.toordinal()) for t in local]).reshape(-1, 2).T
        return cls(hour, day - day.min(initial=day.max(initial=0)), max(days, 1))

    def shares(self, edi_lx: Floats) -> dict[str, Floats]:
        """Return shares of the year with enough melanopic light [%], by name, [d] each.

        edi_lx [n, d]. `ENOUGH_HOURS` is of the hours from 06:00 to 19:00; `ENOUGH_DAYS` are of the
        days on which all four hours from 09:00 to 13:00 have enough. Hours in the dark count as
        without light. A direction without any EDI has NaN.
        """
        first, last = BROWN_HOURS
        enough = edi_lx[(self.hour >= first) & (self.hour < last)] >= BROWN_EDI_LX
        count = {ENOUGH_HOURS: enough.sum(axis=0) / (last - first)}
        rows, first = np.isin(self.hour, range(*WELL_HOURS)), WELL_HOURS[0]
        at = self.hour[rows] - first, self.day[rows]
        least = np.zeros((WELL_HOURS[1] - first, int(at[1].max(initial=0)) + 1, edi_lx.shape[1]))
        least[at] = edi_lx[rows]
        least = least.min(axis=0)
        limits = zip(ENOUGH_DAYS, WELL_EDI_LX, strict=True)
        count |= {name: (least >= limit).sum(axis=0) for name, limit in limits}
        has_edi = np.isfinite(edi_lx).any(axis=0)
        return {k: np.where(has_edi, 100.0 * c / self.days, np.nan) for k, c in count.items()}


def edi_budget(
    colours: MelanopicYear, views: Mapping[str, Floats], hours: YearHours, azimuths_deg: Floats
) -> list[budget.Budget]:
    """Return the budgets of `YearHours.shares`, for each direction.

    views: results of `MelanopicYear.figures` for all hours. Another year's weather is not in it.
    """
    edi, of_map = views["melanopic_edi_lx"], views["edi_of_map_lx"]
    share, of_sun, u_fit = budget.of_share, edi - of_map, colours.u_fit_rel
    fit = share("ratio by sky, sun and direction", "A", u_fit, budget.MODEL.shared_by)
    at, more = hours.shares(edi), hours.shares(edi + views["edi_of_unseen_lx"])
    changes = [
        (budget.MODEL, views["edi_by_model_lx"]),
        (fit, of_map * u_fit),
        *budget.camera_changes(colours.u_camera_rel, of_map),
        (share("illuminance of the sun's disc", "B", budget.U_DISC), of_sun * budget.U_DISC),
        (share("colour of the sun's disc", "B", U_SUN_RATIO), of_sun * U_SUN_RATIO),
        (budget.DISC_SEEN, np.moveaxis(views["edi_by_disc_lx"], -1, 0)),
    ]
    unseen = budget.UNSEEN, {name: more[name] - at[name] for name in at}
    return budget.budgets_of_year(hours.shares, edi, azimuths_deg, changes, unseen, "%")
