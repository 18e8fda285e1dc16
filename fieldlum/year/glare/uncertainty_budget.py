"""List what makes a figure uncertain, source by source, as the GUM asks (JCGM 100:2008, clause 8).

A picture that `merge` wrote states the uncertainties that all its pixels share (`u_percent`); what
remains of each pixel's u is independent of the other pixels. A year's figure shares the camera's
scale over all its hours.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import VEILING_GLARE, SunSource
from fieldlum.core.strict_csv import read_table
from fieldlum.optics.melanopic import U_SUN_RATIO, melanopic_edi, melanopic_ratio, ratio_u_rel
from fieldlum.optics.projection import direction
from fieldlum.session.codec import warn_if_changed, write_csv
from fieldlum.session.panorama_sun import MEASURED_ORIGINS
from fieldlum.sky.sky_view.pose import STATED_SD
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.year.glare import standards
from fieldlum.year.glare.metrics import brightest_cdm2, glare_directions
from fieldlum.year.glare.picture_glare import take_out_sun, valid_pixels
from fieldlum.year.glare.pictures import Picture, read_picture
from fieldlum.year.glare.sources import panorama_views

# relative u of a disc's illuminance by DNI: luminous efficacy and glass together; not measured
U_DISC = 0.05
BUDGET_FILE = "budget.csv"  # of a predicted year
_NORMAL, CAMERA = "normal", "camera"


class Source(NamedTuple):
    """One source of uncertainty: a row of a budget.

    name: of the uncertain input, as a text for the reader. kind: "A" (from repeated observations)
    or "B" (GUM 4.2, 4.3). distribution: "normal" or "rectangular". u: standard uncertainty of the
    input, in `unit`. shared_by: what has the same error of this input, such as "all hours" or "all
    pixels". contribution: what the source adds to the figure's u, in the unit of `Budget`; the
    sensitivity is contribution over u.
    """

    name: str
    kind: str
    distribution: str
    u: float
    unit: str
    shared_by: str
    contribution: float = 0.0


# Their inputs are standard uncertainties already, so that u is 1 in the unit "u".
MODEL = Source("light transport model", "A", _NORMAL, 1.0, "u", "half: all hours")
DISC_SEEN = Source("whether the sun's disc is seen", "B", _NORMAL, 1.0, "u", "all hours")
UNSEEN = Source("part of the view that no lens saw", "B", "rectangular", 1.0, "u", "hour")


@dataclass(frozen=True, slots=True)
class Budget:
    """The uncertainty budget of one figure in one view direction.

    figure: its name, such as "DGP"; unit: that of `estimate`, the figure's value, and of the
    contributions; azimuth_deg: of the view direction, clockwise from true north; sources: they are
    independent of each other.
    """

    figure: str
    unit: str
    azimuth_deg: float
    estimate: float
    sources: tuple[Source, ...]

    @property
    def u(self) -> float:
        """The combined standard uncertainty, in the budget's `unit` (GUM 5.1.2)."""
        return float(np.sqrt(sum(source.contribution**2 for source in self.sources)))


UNITS = {"DGP": "1", "Ev": "lx", "melanopic EDI": "lx", "luminance ahead": "cd/m2"}


Contribution = tuple[Source, Mapping[str, Floats]]
"""A source, and what it adds to the u of each figure, by name, [d] each."""


class _Scene(NamedTuple):
    """A panorama in d view directions, whose figures after a change of its light are computed.

    luminance_cdm2: [H, W] without the sun's disc; sun: None without one; azimuths_deg: [d].
    """

    picture: Picture
    luminance_cdm2: Floats
    sun: SunSource | None
    azimuths_deg: Floats

    def figures(
        self, more_cdm2: Floats | float = 0.0, more_sun: float = 0.0, turn_deg: float = 0.0
    ) -> dict[str, Floats]:
        """Return DGP, Ev, melanopic EDI, and luminance of the pixel ahead, [d] each.

        The keys are those of `UNITS`, which has the units. more_cdm2: added to the luminance, a
        number or [H, W]; more_sun: share of the sun's illuminance that is added to it; turn_deg:
        added to the view directions, clockwise. A picture without colour has no melanopic EDI.
        """
        panorama, sun, azimuths = self.picture.panorama, self.sun, self.azimuths_deg + turn_deg
        light = np.maximum(self.luminance_cdm2 + more_cdm2, 0.0)
        height, width = light.shape
        grid = panorama_views(height, width, panorama.heading_deg, azimuths)
        rays = None if sun is None else direction(sun.altitude_deg, sun.azimuth_deg)[None]
        lx = None if sun is None else np.array([sun.normal_illuminance_lx * (1 + more_sun)])
        parts = glare_directions(light[None], grid, rays, lx)
        figures = {"DGP": parts["dgp"][0], "Ev": parts["ev_lx"][0]}
        if melanopic_ratio(panorama) is not None:
            of_map = (panorama, light.ravel(), grid.illuminance, sun, parts["sun_ev_lx"][0])
            figures["melanopic EDI"] = melanopic_edi(*of_map, lamps=self.picture.lamps)[0]
        # column of each view direction; the heading is in the middle of the panorama
        ahead = (azimuths - panorama.heading_deg) / 360.0 * width + width / 2
        column = np.floor(ahead).astype(int) % width
        return figures | {"luminance ahead": light[height // 2, column]}

    def half_range(self, **change: Any) -> dict[str, Floats]:
        """Return half the difference of the figures for a change and for its opposite, [d] each.

        change: arguments of `figures`.
        """
        opposite = {name: -1.0 * value for name, value in change.items()}
        up, down = self.figures(**change), self.figures(**opposite)
        return {name: np.abs(up[name] - down[name]) / 2 for name in up}


def budget_of_file(path: Path, azimuths_deg: Sequence[float], lamps: bool | None) -> list[Budget]:
    """Return `picture_budget` of a panorama on disk, with the uncertainty of its heading.

    The heading's uncertainty is that of the camera's pose in the session's sky_view.exr, which is
    searched in the parent of the picture's folder; without it, that of a compass (`STATED_SD`, 2.5
    degrees). azimuths_deg: the view directions, clockwise from north; lamps: whether lamps are on,
    None to use what the session's journal states. Raises InputError for an unusable picture or sky
    view, for a picture that is no panorama, and for pixels that are not finite or without
    uncertainty.
    """
    picture = read_picture(path)
    if picture.view is not None:
        expected, remedy = "a panorama for --budget", "merge a bracket to one"
        raise InputError(path, "a picture of one view", expected, remedy)
    sky = path.absolute().parent.parent / "sky_view.exr"
    u_heading_deg = SkyView.read(sky).pose.heading_sd_deg if sky.is_file() else STATED_SD[0]
    picture = picture if lamps is None else picture._replace(lamps=lamps)
    return picture_budget(picture, path, azimuths_deg, u_heading_deg)


def picture_budget(
    picture: Picture, path: Path, azimuths_deg: Sequence[float], u_heading_deg: float
) -> list[Budget]:
    """Return the budgets of DGP, Ev, melanopic EDI and luminance ahead, for each view direction.

    A figure that is not known, such as melanopic EDI without colour, has no budget. picture: a
    panorama with its sun; path: names it in errors; azimuths_deg: the view directions, clockwise
    from north; u_heading_deg: standard uncertainty of the picture's heading. A picture without the
    attribute `u_percent` (of an earlier version or another program) has one source for the complete
    uncertainty of its pixels, which then counts as shared by all of them. Raises InputError for
    pixels that are not finite, or without uncertainty.
    """
    panorama, azimuths = picture.panorama, np.asarray(azimuths_deg, float)
    light, _ = valid_pixels(panorama, path)
    if panorama.u_cdm2 is None:
        found, expected = "no uncertainty of its pixels", "a panorama by merge"
        raise InputError(path, found, expected, "omit --budget")
    light, sun = take_out_sun(light, panorama.heading_deg, panorama.sun)
    scene = _Scene(picture, light, sun, azimuths)
    rows = [*_of_pixels(scene), *_of_sun_and_views(scene, u_heading_deg), *_of_unseen(scene)]
    return _budgets(scene.figures(), azimuths, rows)


def year_budget(
    dgp: Floats,
    ev_lx: Floats,
    uncertainty: standards.DgpUncertainty,
    occupied_hours: int,
    azimuths_deg: Floats,
    u_camera_rel: Mapping[str, float],
) -> list[Budget]:
    """Return the budget of the DGP that is exceeded in 5 % of the occupied hours, by direction.

    dgp, ev_lx [n, d], uncertainty: those of the n lit occupied hours in d view directions;
    occupied_hours: number of lit and dark ones; azimuths_deg: the view directions [d], clockwise
    from north. u_camera_rel: relative standard uncertainty by each part of the camera's
    calibration. Another year's weather, a blind that moves and clouds that move within the hour are
    not in it.
    """
    name, per_scale = "DGP exceeded in 5 %", standards.dgp_per_scale(dgp, ev_lx)

    def exceeded(values: Floats) -> dict[str, Floats]:
        """Return the DGP exceeded in 5 % of the occupied hours, [d]; values: DGP [n, d]."""
        return {name: standards.exceeded_in_share(np.clip(values, 0.0, 1.0), occupied_hours)}

    low, high = (exceeded(bound)[name] for bound in (uncertainty.minimum, uncertainty.maximum))
    changes = [(MODEL, uncertainty.u_maps), *camera_changes(u_camera_rel, per_scale)]
    changes.append((DISC_SEEN, uncertainty.drawn - dgp))
    unseen = (UNSEEN, {name: np.abs(high - low) / np.sqrt(12.0)})
    return budgets_of_year(exceeded, dgp, azimuths_deg, changes, unseen)


def of_share(name: str, kind: str, u_rel: float, shared_by: str = "all hours") -> Source:
    """Return a source with the relative standard uncertainty `u_rel`, as `Source.u` in percent.

    name, kind, shared_by: fields of `Source`; its distribution is normal.
    """
    return Source(name, kind, _NORMAL, 100 * u_rel, "%", shared_by)


def camera_changes(u_rel: Mapping[str, float], figure: Floats) -> list[tuple[Source, Floats]]:
    """Return each part of the camera's calibration as a source, with what its u adds to a figure.

    u_rel: relative standard uncertainty by name of the part; figure: derivative of the figure in n
    hours and d directions with respect to a common factor on all luminances, [n, d]. What u adds
    has this shape and the unit of the figure.
    """
    return [(of_share(f"{CAMERA} {name}", "B", u), u * figure) for name, u in u_rel.items()]


def share_of(name: str, budgets: Sequence[Budget]) -> float:
    """Return the share (0 to 1) of some sources in the summed variance of `budgets`.

    name: of a source, or what several names begin with. The budgets must be of figures with the
    same unit. Without any variance the share is 0.
    """
    sources = [source for each in budgets for source in each.sources]
    some = sum(s.contribution**2 for s in sources if s.name.startswith(name))
    return some / max(sum(s.contribution**2 for s in sources), 1e-12)


def budgets_of_year(
    figures: Callable[[Floats], dict[str, Floats]],
    values: Floats,
    azimuths_deg: Floats,
    changes: Sequence[tuple[Source, Floats]],
    unseen: Contribution,
    unit: str = "1",
) -> list[Budget]:
    """Return the budgets of a year's figures: functions of the values of n hours in d directions.

    figures: computes the figures of values [n, d], by name, [d] each. values: the best estimate of
    the values, [n, d]. azimuths_deg: the directions [d], clockwise from north. changes: each source
    with what one u of it adds to the values, [n, d]: it is multiplied by one random number for all
    hours, or by `standards.year_errors` if the source is shared as `MODEL` is; or with m random
    draws of its error, [m, n, d]. unseen: what the unseen part adds to the figures. unit: that of
    figures that are not in `UNITS`.

    The figures are no linear functions. So the u of a figure, before `unseen` is added, is the rms
    difference of 400 draws with errors of all sources from the estimate (JCGM 101:2008). The rms
    differences with errors of one source alone are scaled so that their squares add up to that of
    u. Both are NaN for a model that states no error.
    """
    rng, shape, estimate = np.random.default_rng(0), values.shape, figures(values)

    def random_error(source: Source, change: Floats) -> Floats:
        """Return one random error of the values by a source, [n, d].

        change: of the source, as in `changes`: [n, d] for one u, or [m, n, d] for m draws.
        """
        if change.ndim == 3:
            return change[rng.integers(len(change))]
        by_hour = source.shared_by == MODEL.shared_by
        return change * (standards.year_errors(shape, rng) if by_hour else rng.standard_normal())

    def spread(drawn: Sequence[dict[str, Floats]]) -> dict[str, Floats]:
        """Return the rms difference of drawn figures from the estimates, by name, [d] each.

        drawn: the figures of each draw, by name, [d] each.
        """
        off = {name: np.array([draw[name] for draw in drawn]) - estimate[name] for name in estimate}
        return {name: np.sqrt(np.mean(part**2, axis=0)) for name, part in off.items()}

    draws = []  # the figures with errors of all sources together, then of each source alone
    for _ in range(standards.DRAWS):
        errors = [random_error(source, change) for source, change in changes]
        draws.append([figures(values + off) for off in (sum(errors), *errors)])
    total, *parts = (spread(drawn) for drawn in zip(*draws, strict=True))
    sums = {name: np.linalg.norm([part[name] for part in parts], axis=0) for name in estimate}
    scaled = [{n: p[n] * total[n] / np.maximum(sums[n], 1e-12) for n in estimate} for p in parts]
    rows = [(source, part) for (source, _), part in zip(changes, scaled, strict=True)]
    return _budgets(estimate, azimuths_deg, [*rows, unseen], unit)


def _budgets(
    estimates: Mapping[str, Floats], azimuths: Floats, rows: Sequence[Contribution], unit: str = "1"
) -> list[Budget]:
    """Return a budget for each direction and figure, without figures that are not finite.

    estimates: the figures by name, [d] each; azimuths: the directions [d] in degrees; rows: what
    each source adds to the u of each figure; unit: that of figures that are not in `UNITS`.
    """
    budgets = []
    for i, azimuth_deg in enumerate(azimuths.tolist()):
        for name in (name for name, values in estimates.items() if np.isfinite(values[i])):
            adding = [(source, added[name][i]) for source, added in rows if name in added]
            sources = tuple(source._replace(contribution=float(share)) for source, share in adding)
            estimate = float(estimates[name][i])
            budgets.append(Budget(name, UNITS.get(name, unit), azimuth_deg, estimate, sources))
    return budgets


COLUMNS = (
    *("file", "figure", "azimuth_deg", "estimate", "unit", "source", "type", "distribution"),
    *("u_source", "unit_of_source", "sensitivity", "contribution", "share_percent", "equal_in"),
)


def write_budgets(path: Path, budgets: Iterable[tuple[str, Budget]]) -> None:
    """Write a csv with `COLUMNS`: for each budget a row for each source, and one of the combined u.

    An earlier file is replaced. budgets: pairs of the name of the file that a budget is of, such as
    a picture, and the budget.
    """
    rows: list[tuple[object, ...]] = []
    for file, each in budgets:
        head = (file, each.figure, f"{each.azimuth_deg:g}", f"{each.estimate:.6g}", each.unit)
        for s in each.sources:
            share = 100 * s.contribution**2 / max(each.u**2, 1e-300)
            figures = (s.u, s.unit, s.contribution / max(s.u, 1e-300), s.contribution, share)
            rows.append((*head, s.name, s.kind, s.distribution, *figures, s.shared_by))
        rows.append((*head, "combined", "", _NORMAL, "", "", "", each.u, "100", ""))
    write_csv(path, (dict(zip(COLUMNS, row, strict=True)) for row in rows), COLUMNS, digits=4)


def read_budgets(path: Path) -> list[dict[str, str]]:
    """Return the rows that `write_budgets` wrote, as dicts of texts by column.

    The list is empty for a missing file. Warns if the file was changed after it was written. Raises
    InputError for a file that cannot be read or lacks one of `COLUMNS`, and for a direction,
    contribution or share that is no number.
    """
    if not path.is_file():
        return []
    expected, remedy = "an uncertainty budget", "predict the year again: fieldlum predict"
    rows = [row for _, row in read_table(path, expected, remedy, needed=COLUMNS).dicts()]
    warn_if_changed(path)
    with input_errors(path, expected, remedy, ValueError):  # a text that is no number
        [float(row["azimuth_deg"]) for row in rows]
        [float(row[name] or 0) for row in rows for name in ("contribution", "share_percent")]
    return rows


def _of_pixels(scene: _Scene) -> Iterator[Contribution]:
    """Yield the sources of the pixels' errors, with what each adds to the u of each figure.

    First those that all pixels share, then what remains of each pixel's u. A sun that the camera
    measured has the shared errors too.
    """
    panorama, light, sun = scene.picture.panorama, scene.luminance_cdm2, scene.sun
    by_camera = sun is not None and sun.origin in MEASURED_ORIGINS
    u = np.nan_to_num(np.asarray(panorama.u_cdm2, float))
    rest = np.where(panorama.seen, u, 0.0) ** 2  # variance [H, W] that no source explains yet
    sines = np.sin((np.arange(len(light)) + 0.5) / len(light) * np.pi)[:, None] * (light > 0)
    mean_seen = float((light * sines).sum() / max(sines.sum(), 1e-9))
    stated = panorama.shared_u_rel
    for name, u_rel in stated.items():
        share = u_rel * (np.full_like(light, mean_seen) if name == VEILING_GLARE else light)
        rest -= share**2
        change = scene.half_range(more_cdm2=share, more_sun=u_rel * by_camera)
        yield of_share(name, "B", u_rel, "all pixels"), change
    rest = np.sqrt(np.maximum(rest, 0.0))
    mean = 100 * float(rest.sum() / max(light.sum(), 1e-9))
    if stated:
        name = "noise, edges and other parts of single pixels"
        rng = np.random.default_rng(0)
        # their standard deviation, a small part of the budget, is known to 7 %
        draws = [scene.figures(rest * rng.standard_normal(rest.shape)) for _ in range(100)]
        change = {name: np.std([d[name] for d in draws], axis=0, ddof=1) for name in draws[0]}
        yield Source(name, "A", _NORMAL, mean, "%", "no other pixel"), change
    elif rest.any():
        change = scene.half_range(more_cdm2=rest)
        yield Source("pixels, as stated", "B", _NORMAL, mean, "%", "all pixels"), change


def _of_sun_and_views(scene: _Scene, u_heading_deg: float) -> Iterator[Contribution]:
    """Yield the sources sun's disc, heading and melanopic colour, with what each adds to u.

    scene: the picture in its view directions; u_heading_deg: standard uncertainty of its heading.
    """
    if scene.sun is not None:
        change, name = scene.half_range(more_sun=U_DISC), "illuminance of the sun's disc"
        yield of_share(name, "B", U_DISC, "disc"), change
    change = scene.half_range(turn_deg=u_heading_deg)
    yield Source("heading", "B", _NORMAL, u_heading_deg, "deg", "all pixels"), change
    if (colour := melanopic_ratio(scene.picture.panorama)) is not None:
        at, of_sun = scene.figures(), scene.half_range(more_sun=1.0)  # half of 2 E less half of 0
        edi, ev_lx = (at[name] - of_sun[name] for name in ("melanopic EDI", "Ev"))
        u_rel = ratio_u_rel(edi / np.maximum(ev_lx, 1e-9), colour[1], lamps=scene.picture.lamps)
        source = of_share("melanopic ratio by colour", "B", float(u_rel.mean()), "all")
        yield source, {"melanopic EDI": edi * u_rel}
        change = {"melanopic EDI": of_sun["melanopic EDI"] * U_SUN_RATIO}
        yield of_share("colour of the sun's disc", "B", U_SUN_RATIO, "disc"), change


def _of_unseen(scene: _Scene) -> Iterator[Contribution]:
    """Yield what no lens saw as a source: black, or one luminance up to the brightest 1 % seen."""
    panorama = scene.picture.panorama
    unseen, (height, width) = ~panorama.seen, panorama.seen.shape
    if not unseen.any():
        return
    grid = panorama_views(height, width, panorama.heading_deg, scene.azimuths_deg, panorama.seen)
    most_cdm2 = max(float(brightest_cdm2(scene.luminance_cdm2[None], grid)[0]), 1.0)
    levels = [0.0, *most_cdm2 ** np.linspace(0.0, 1.0, 4)]
    tried = [scene.figures(level * unseen) for level in levels]
    yield UNSEEN, {n: np.ptp([t[n] for t in tried], axis=0) / np.sqrt(12.0) for n in tried[0]}
