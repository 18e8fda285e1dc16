"""Predict melanopic EDI of a year from the colours of the captures.

Sky, sun and lamps have their own colours. The ratio of melanopic to photopic light in a view
direction is the sum, over sky, sun and lamps, of the ratio of each times its share in the
illuminance, times a factor of the direction for the colours of glass and walls. The captures give
the ratios and factors; the shares are those of a kernel fit to the captures' vertical illuminance,
so that no map is predicted for it.
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
from fieldlum.core.room_states import LAMP_OFF, is_lit
from fieldlum.learn.models.training_data import states_of
from fieldlum.optics import images, melanopic
from fieldlum.session import sha256
from fieldlum.session.codec import data_digest
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.sky import light_similarity
from fieldlum.sky.daylight import MIN_LX, Light, light_at
from fieldlum.sky.light_similarity import LAMP_LX, Facades, Features, Kernel
from fieldlum.sky.sun import horizontal_beam, standard_time
from fieldlum.year.glare import metrics
from fieldlum.year.glare import uncertainty_budget as budget
from fieldlum.year.glare.sources import panorama_views
from fieldlum.year.predict.occupancy import known_hours

if TYPE_CHECKING:
    from fieldlum.weather import Weather
    from fieldlum.year.predict.hour_blocks import ModelRoom

Figures = Mapping[str, Floats]

# Typical weights for rooms whose captures do not determine them: the ratio of an overcast sky, what
# a clear sky adds, the sun's ratio over `sun_melanopic_ratio` (fits to two simulated rooms with a
# coloured sky), and the ratio of lamps by their colour (white LED of 3000 to 5000 K: 0.5 to 0.8).
# They count as much as _PRIOR captures.
_TYPICAL, _PRIOR = np.array([1.0, 0.25, 0.95, 0.65]), 2.0


@dataclass(frozen=True, slots=True)
class MelanopicYear:
    """A fit of the ratio of melanopic to photopic light to n captures, in d view directions.

    kernel, captured : covariance between hours, and the captures' features; coefficients [n, d] :
    kernel(hours, captured) @ coefficients is vertical illuminance over the total light outside.
    u_camera_rel : relative standard uncertainty by name of each part of the camera's calibration.
    weights [4] : ratio of the light of an overcast sky, what a clear sky adds to it, ratio of the
    sun over `sun_melanopic_ratio`, and ratio of lamps; factors [d] : of the ratio in each
    direction, for the colours of glass and walls; u_fit_rel : relative standard uncertainty of the
    ratio by days held out.
    """

    kernel: Kernel
    captured: Features
    coefficients: Floats
    u_camera_rel: Mapping[str, float]
    weights: Floats
    factors: Floats
    u_fit_rel: float = 0.0

    @property
    def u_rel(self) -> float:
        """Relative standard uncertainty of the fit and of the camera's calibration together."""
        return float(np.hypot(self.u_fit_rel, np.linalg.norm([*self.u_camera_rel.values()])))

    def shares(self, light: Light) -> tuple[Floats, Floats]:
        """Return the shares (0 to 1) of the sun and of lamps in the light at the eye, [n, d] each.

        light : of n hours. The shares are what the kernel's prediction for the same hours lacks
        without the sun, or without lamps.
        """

        def ev_lx(light: Light) -> Floats:
            """Return the vertical illuminance that the kernel predicts for n hours, [n, d]."""
            values = self.kernel(_features(light), self.captured) @ self.coefficients
            return np.maximum(values, 0.0) * light.total_lx[:, None]

        complete = np.maximum(ev_lx(light), MIN_LX)
        less = (_without_sun(light), replace(light, states=None))
        sun, lamp = (np.clip(1.0 - ev_lx(part) / complete, 0.0, 1.0) for part in less)
        return np.minimum(sun, 1.0 - lamp), lamp

    def ratio(self, light: Light) -> Floats:
        """Return melanopic EDI over vertical illuminance in n hours, by the fit alone, [n, d].

        It does not contain `LAMP_RATIO`, for the spectra of lamps (see `figures`).
        """
        return _parts(light, *self.shares(light)) @ self.weights * self.factors

    def figures(
        self, light: Light, views: Figures, u_map_rel: Floats, drawn_lx: Floats, unseen_lx: Floats
    ) -> dict[str, Floats]:
        """Return melanopic EDI [lx] of n hours in d directions and its standard uncertainty.

        Arrays are [n, d], but edi_by_disc_lx is [n, d, m]. The keys melanopic_edi_lx and
        u_melanopic_edi_lx are columns of hourly.csv; the others are parts of both, for
        `edi_budget`. views : figures of the hours, with `ev_lx` and `sun_ev_lx`; u_map_rel :
        relative standard uncertainty of the map's part of `ev_lx`; drawn_lx [m, n, d] : Ev in m
        draws of the sun's disc; unseen_lx : the most that the unseen part of the view adds to Ev.
        With a lamp on, the ratio of melanopic to photopic light is `LAMP_RATIO` of that by colour.
        The uncertainty allows for a lamp in each hour that is not marked lamp=off.
        """
        by_colour, states = self.ratio(light), light.states or ("",) * len(light)
        may_be_lit = np.array([[LAMP_OFF not in text] for text in states])
        # 0.0, so that only the unknown spectrum of lamps counts here: the uncertainty under
        # daylight (fit and camera, `self.u_rel`) is added below.
        u_lamp_rel = melanopic.ratio_u_rel(by_colour, u_rel=0.0) * may_be_lit
        ratio = by_colour * np.where(_lit(light), melanopic.LAMP_RATIO, 1.0)
        of_map = (views["ev_lx"] - views["sun_ev_lx"]) * ratio
        sun_ratio = melanopic.sun_melanopic_ratio(light.apparent_altitude_deg)[:, None]
        of_sun = views["sun_ev_lx"] * sun_ratio
        drawn = ((drawn_lx - views["ev_lx"]) * sun_ratio).astype(np.float32)
        unseen = unseen_lx * ratio / np.sqrt(3.0)  # rms of 0 to this, about 0
        u_of_map_rel = np.sqrt(self.u_rel**2 + u_map_rel**2 + u_lamp_rel**2)
        parts = (of_map * u_of_map_rel, of_sun * melanopic.U_SUN, unseen)
        u = np.sqrt(sum(part**2 for part in parts) + (drawn**2).mean(axis=0))
        return {
            "melanopic_edi_lx": of_map + of_sun,
            "u_melanopic_edi_lx": u,
            "edi_of_map_lx": of_map,
            "edi_by_model_lx": of_map * u_map_rel,
            "edi_by_lamps_lx": of_map * u_lamp_rel,
            "edi_of_unseen_lx": unseen,
            "edi_by_disc_lx": np.moveaxis(drawn, 0, -1),  # [n, d, m]
        }


def _lit(light: Light) -> Mask:
    """Return a mask [n, 1], True for the hours in which a lamp is on."""
    return np.array([[is_lit(text)] for text in light.states or ("",) * len(light)])


def _features(light: Light) -> Features:
    """Return the features of n hours for the kernel, with the one of lamps."""
    lamps = _lit(light) * (LAMP_LX / light.total_lx)[:, None]
    return replace(light_similarity.light_features(light), lamps=lamps)


def _parts(light: Light, sun_share: Floats, lamp_share: Floats) -> Floats:
    """Return the light that each weight of `MelanopicYear` multiplies, [n, d, 4].

    These are shares (0 to 1) of the light at the eye: of the sky, of the sky times its clearness,
    of the sun times its own ratio, and of lamps. sun_share, lamp_share: of n hours in d directions
    [n, d].
    """
    beam = horizontal_beam(light.dni_wm2, light.sun_altitude_deg)
    clear = (beam / np.maximum(beam + light.dhi_wm2, 1.0))[:, None]
    sky = 1.0 - sun_share - lamp_share
    sun = sun_share * melanopic.sun_melanopic_ratio(light.apparent_altitude_deg)[:, None]
    return np.stack([sky, sky * clear, sun, lamp_share], axis=-1)


def fit_year(
    light: Light, ev_lx: Floats, edi_lx: Floats, u_camera_rel: Mapping[str, float], facades: Facades
) -> MelanopicYear:
    """Fit the ratio of melanopic to photopic light to n captures in d view directions.

    light : that of the captures; ev_lx, edi_lx : vertical illuminance and melanopic EDI without the
    sun's disc, [n, d], ev_lx above 0; u_camera_rel : relative standard uncertainty by name of each
    part of the camera's calibration; facades : those of the room. The fit's uncertainty is the rms
    error for days (UTC) that were held out; 10 % (chosen) if all captures are of one day.
    """
    ratio, errors = edi_lx / ev_lx, []
    day = np.array([t.toordinal() for t in light.t_utc])

    def fitted(rows: Mask) -> MelanopicYear:
        """Return the fit to some of the captures; rows: mask [n], True for those."""
        kernel, used = Kernel(facades), light[rows]
        features = _features(used)
        # The variance of a capture is the middle one of the transport model's `NOISES`.
        covariance = kernel(features, features) + 1e-2 * np.eye(len(used))
        relative = ev_lx[rows] / used.total_lx[:, None]
        coefficients = np.linalg.solve(covariance, relative)
        factors = np.ones(ratio.shape[1])
        year = MelanopicYear(kernel, features, coefficients, u_camera_rel, _TYPICAL, factors)
        weights, factors = _solve(_parts(used, *year.shares(used)), ratio[rows])
        return replace(year, weights=weights, factors=factors)

    for held in np.unique(day):
        rows = day != held
        if rows.any():
            errors.append(fitted(rows).ratio(light[~rows]) / ratio[~rows])
    off = np.concatenate(errors) - 1.0 if errors else np.full((1, 1), 0.1)
    return replace(fitted(np.ones(len(day), bool)), u_fit_rel=float(np.sqrt(np.mean(off**2))))


def _solve(parts: Floats, ratio: Floats) -> tuple[Floats, Floats]:
    """Return the weights [4] by relative least squares, and the factors of the directions [d].

    parts: what the weights multiply, by `_parts` [n, d, 4]; ratio: melanopic over photopic
    illuminance of n captures [n, d]. Few captures are pulled towards typical weights.
    """
    rows = (parts / ratio[..., None]).reshape(-1, len(_TYPICAL))
    # rms of what each weight multiplies; the minimum keeps the weight of absent lamps typical
    size = np.maximum(np.sqrt((rows**2).mean(axis=0)), 1e-3)
    pull = np.sqrt(_PRIOR * ratio.shape[1]) * np.diag(size)
    right = np.concatenate([np.ones(len(rows)), pull @ _TYPICAL])
    weights = np.linalg.lstsq(np.concatenate([rows, pull]), right, rcond=None)[0]
    count = len(ratio)
    off = (ratio / (parts @ weights)).mean(axis=0) - 1.0
    return weights, 1.0 + off * count / (count + _PRIOR)


def _without_sun(light: Light) -> Light:
    """Return the light without direct sun, and without what the sun adds to that of the ground."""
    sky, dark = light.sky, np.zeros(len(light))
    beam = horizontal_beam(sky.direct_lx, light.sun_altitude_deg)
    ground = sky.ground_cdm2 * sky.diffuse_lx / np.maximum(sky.diffuse_lx + beam, MIN_LX)
    perez = replace(sky, direct_lx=dark, ground_cdm2=ground)
    return replace(light, dni_wm2=dark, perez=perez)


def digests(pairs: Path) -> dict[str, str]:
    """Return what EDI of a year is computed from: a digest of each usable capture, by its picture.

    pairs: path of the csv. The digest is of the capture's time, irradiance, state and picture. The
    result is empty if the first usable picture is missing or has no melanopic colour: then a year
    has no EDI. Raises InputError for a damaged file.
    """
    rows, found = [row for row in PairsFile.find(pairs).usable if row.panorama], {}
    first = pairs.parent / rows[0].panorama if rows else pairs
    if not (rows and first.is_file() and melanopic.melanopic_ratio(images.read_panorama(first))):
        return {}
    for row, state in zip(rows, states_of(pairs, rows) or [""] * len(rows), strict=True):
        path = pairs.parent / row.panorama
        picture = sha256(path) if path.is_file() else ""
        found[row.panorama] = data_digest(row.t_utc, row.dni_wm2, row.dhi_wm2, state, picture)[:16]
    return found


def year_of_captures(
    pairs: Path, room: ModelRoom, azimuths_deg: Floats, u_camera_rel: Mapping[str, float]
) -> MelanopicYear:
    """Fit the ratio of melanopic to photopic light to the pictures of a pairs.csv.

    pairs: path of the file; at most 80 of its usable pictures are read. Pictures with the sun in
    the map are left out. room: that of the model, whose pose the pictures have; azimuths_deg: the
    view directions [d], clockwise from north; u_camera_rel: relative standard uncertainty by name
    of each part of the camera's calibration. Raises InputError for a damaged file,
    NotEnoughDataError if no picture has melanopic colour.
    """
    views = panorama_views(room.height, room.width, room.heading_deg, azimuths_deg, room.seen)
    usable = [row for row in PairsFile.find(pairs).usable if row.panorama and not row.sun_in_map]
    # at most 80 captures are read, which limits the time
    step = -(-len(usable) // 80) if usable else 1
    rows: list[PairRow] = []
    eye_lx, u_rel = [], 0.0
    for row in usable[::step]:
        picture = images.read_panorama(pairs.parent / row.panorama)
        if (colour := melanopic.melanopic_ratio(picture)) is not None:
            light = np.maximum(np.nan_to_num(picture.luminance_cdm2), 0.0)
            eye_lx.append(metrics.map_ev_lx(np.stack([light, light * colour[0]]), views))
            rows, u_rel = [*rows, row], max(u_rel, colour[1])
    if not rows:
        raise NotEnoughDataError(f"{pairs}: no picture has melanopic colour; merge them again")
    dni, dhi = np.array([(row.dni_wm2, row.dhi_wm2) for row in rows]).T
    light = light_at([row.t_utc for row in rows], room.setup.site, dni, dhi)
    light = replace(light, states=states_of(pairs, rows))
    ev_lx, edi_lx = np.moveaxis(np.array(eye_lx), 1, 0)
    u_parts_rel = {**u_camera_rel, "melanopic weight": u_rel}
    facades = light_similarity.facades_of(room.setup.room)
    return fit_year(light, np.maximum(ev_lx, MIN_LX), edi_lx, u_parts_rel, facades)


# ----------------------------------------------------------------------------------------------
# the year's figures and their uncertainty budget

BROWN_EDI_LX, BROWN_HOURS = 250.0, (6, 19)  # Brown et al., PLOS Biology 20 (2022)
WELL_EDI_LX, WELL_HOURS = (109.0, 136.0, 163.0, 250.0), (9, 13)  # WELL v2, L03
ENOUGH_HOURS = f"mEDI of {BROWN_EDI_LX:.0f} lx or more, hours 06:00 to 19:00"
ENOUGH_DAYS = tuple(f"mEDI of {limit:.0f} lx or more, days 09:00 to 13:00" for limit in WELL_EDI_LX)


@dataclass(frozen=True, slots=True)
class YearHours:
    """The times of n daylight hours, in local standard time.

    hour: of the day, 0 to 23, in which the moment is [n]; day: number of days since the earliest
    one [n]. known: as in `PredictFile`.
    """

    hour: Array
    day: Array
    known: tuple[int, int]

    @classmethod
    def of(cls, t_utc: Sequence[datetime], zone: str, summary: PredictFile) -> YearHours:
        """Return the times t_utc [n] as `YearHours`.

        zone: IANA name, for standard time; summary: of the year. One of an earlier version does not
        state what is known: all 13 hours of its days count.
        """
        known = summary.known if any(summary.known) else (13 * summary.days, summary.days)
        local = [standard_time(t, zone) for t in t_utc]
        hour, day = np.array([(t.hour, t.toordinal()) for t in local]).reshape(-1, 2).T
        return cls(hour, day - day.min(initial=day.max(initial=0)), known)

    def shares(self, edi_lx: Floats) -> dict[str, Floats]:
        """Return shares of the year with enough melanopic light [%], by name, [d] each.

        edi_lx [n, d]: melanopic EDI of the hours in d view directions. The key `ENOUGH_HOURS` is
        the share of the hours from 06:00 to 19:00 with at least 250 lx (Brown et al. 2022). Each
        key of `ENOUGH_DAYS` is the share of the days on which all four hours from 09:00 to 13:00
        have at least its limit, 109, 136, 163 or 250 lx (WELL v2, L03). Hours in the dark count as
        without light. Hours with the sun up but without weather, and days with such an hour from
        09:00 to 13:00, are left out. A direction without any EDI has NaN, as has a share of none.
        """
        first, last = BROWN_HOURS
        enough = edi_lx[(self.hour >= first) & (self.hour < last)] >= BROWN_EDI_LX
        share = {ENOUGH_HOURS: enough.sum(axis=0) / (self.known[0] or np.nan)}
        rows, first = np.isin(self.hour, range(*WELL_HOURS)), WELL_HOURS[0]
        by_day = np.zeros(
            (WELL_HOURS[1] - first, int(self.day.max(initial=0)) + 1, edi_lx.shape[1])
        )
        by_day[self.hour[rows] - first, self.day[rows]] = edi_lx[rows]  # [hours, days, d]
        days = (by_day.min(axis=0) >= np.array(WELL_EDI_LX)[:, None, None]).sum(axis=1)
        share |= dict(zip(ENOUGH_DAYS, days / (self.known[1] or np.nan), strict=True))
        has_edi = np.isfinite(edi_lx).any(axis=0)
        return {name: np.where(has_edi, 100.0 * s, np.nan) for name, s in share.items()}


def known(weather: Weather) -> tuple[int, int]:
    """Return `PredictFile.known` of a weather file: numbers of hours and days for the shares."""
    _, mask = known_hours(weather.t_utc, weather.site)  # [days, 24]
    days = mask[:, slice(*WELL_HOURS)].all(axis=1)
    return int(mask[:, slice(*BROWN_HOURS)].sum()), int(days.sum())


def edi_budget(
    colours: MelanopicYear, views: Figures, hours: YearHours, azimuths_deg: Floats
) -> list[budget.Budget]:
    """Return uncertainty budgets of the shares of a year with enough melanopic EDI [%].

    The five shares of `YearHours.shares` are of the hours from 06:00 to 19:00 with at least 250 lx,
    and of the days with at least 109, 136, 163 or 250 lx from 09:00 to 13:00. There is one budget
    for each of d view directions and each share that is not NaN, in that order. colours: the fit;
    views: results of `colours.figures` for all n hours, by key; hours: the times of these hours;
    azimuths_deg: the directions [d], clockwise from north. The budgets do not contain that another
    year has other weather.
    """
    edi, of_map = views["melanopic_edi_lx"], views["edi_of_map_lx"]
    share, of_sun, u_sun = budget.of_share, edi - of_map, melanopic.U_SUN_RATIO
    u_fit = colours.u_fit_rel
    u_lamp = float(views["edi_by_lamps_lx"].sum() / max(of_map.sum(), MIN_LX))  # the mean
    fit = share("ratio by sky, sun and direction", "A", u_fit, budget.MODEL.shared_by)
    at, more = hours.shares(edi), hours.shares(edi + views["edi_of_unseen_lx"])
    changes = [
        (budget.MODEL, views["edi_by_model_lx"]),
        (fit, of_map * u_fit),
        (share("spectrum of lamps", "B", u_lamp), views["edi_by_lamps_lx"]),
        *budget.camera_changes(colours.u_camera_rel, of_map),
        (share("illuminance of the sun's disc", "B", budget.U_DISC), of_sun * budget.U_DISC),
        (share("colour of the sun's disc", "B", u_sun), of_sun * u_sun),
        (budget.DISC_SEEN, np.moveaxis(views["edi_by_disc_lx"], -1, 0)),
    ]
    unseen = (budget.UNSEEN, {name: more[name] - at[name] for name in at})
    return budget.budgets_of_year(hours.shares, edi, azimuths_deg, changes, unseen, "%")
