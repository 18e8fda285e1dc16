"""Fit the absolute factor k to spot luminances and illuminances, with its uncertainty."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place
from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Flag, Panorama, listed
from fieldlum.optics.illuminance import illuminance_lx
from fieldlum.optics.images import calibration_mark
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import FULLY_SEEN_SHARE

# A reading is an outlier if it differs from the fit by more than this and by more than three u. A
# spot whose mean has a larger relative u has an edge in its field. Chosen, not measured.
MIN_OUTLIER = 0.1
_UNITS = "1 fL = 3.426 cd/m2, 1 fc = 10.76 lx, 1 klx = 1000 lx"


class LuminanceReading(NamedTuple):
    """One comparison of a meter's reading with the picture's value at the same place.

    kind: "spot" or "illuminance". label: name of the reading, for messages. meter, image: value by
    the meter and by the picture at the profile's k, in cd/m2 for a spot, else in lx. u_rel:
    relative uncertainty of their ratio, without that of the meter's calibration; u_image: the part
    of the picture's value. place: in its panorama, None if unknown.
    """

    kind: str
    label: str
    meter: float
    image: float
    u_rel: float
    u_image: float = 0.0
    place: Place | None = None


class ScaleFit(NamedTuple):
    """A fitted factor on k, its relative uncertainty, and how well the readings agree with it.

    factor: multiplies the profile's k. u_rel: standard uncertainty of the new k, the meter's
    calibration included. residual [n]: meter's value / corrected picture's value - 1. far: labels
    of outliers, which count less in the fit. line: a sentence with the held-out error.
    """

    factor: float
    u_rel: float
    residual: Floats
    far: tuple[str, ...]
    line: str


def from_table(
    path: Path, profile: CameraProfile
) -> tuple[list[LuminanceReading], list[Path], tuple[str, ...]]:
    """Return the readings of a csv, the files of its panoramas, and notes for the user.

    The columns are panorama (a path, relative to the csv), azimuth_deg (clockwise from north),
    altitude_deg, and luminance_cdm2 or illuminance_lx; optional is u_rel, the relative uncertainty
    of a reading (default 0.02). The picture's luminance is the trimmed mean over a disc of 1
    degree, its illuminance that on a plane which faces the direction, both converted from the k of
    the merge to the profile's k. Raises InputError for a line with both or neither reading, a place
    that is clipped or without light, a plane in partial view, and pictures of another calibration.
    """
    optional = {"luminance_cdm2": None, "illuminance_lx": None, "u_rel": fit_steps.READING_U}
    rows = fit_steps.read_table(path, ("panorama", "azimuth_deg", "altitude_deg"), optional)
    pictures = fit_steps.read_panoramas(rows, profile)
    to_k = {file: _to_k(file, picture, profile) for file, picture in pictures.items()}
    readings = [_reading(path, r, pictures[r["panorama"]], to_k[r["panorama"]]) for r in rows]
    unmarked = ", ".join(file.name for file, p in pictures.items() if "k" not in p.attributes)
    uneven = ", ".join(r.label for r in readings if r.u_image > MIN_OUTLIER)
    low = "the luminance is uneven around these readings, which have a low weight"
    notes = {
        f"no factor k is stored in {unmarked}: the profile's is assumed; merge again": unmarked,
        f"{low}: {uneven}: measure places that are even over two degrees": uneven,
    }
    return readings, list(pictures), tuple(note for note, names in notes.items() if names)


def _reading(path: Path, row: fit_steps.CsvRow, picture: Panorama, to_k: float) -> LuminanceReading:
    """Return a reading, with the picture's value at its place.

    row: its line of the csv at `path`; picture: the panorama that it names; to_k: factor that
    converts the picture's luminance to the profile's k. Raises InputError for neither or both of
    luminance and illuminance, and for clipped or unseen pixels.
    """
    at = Place(row["panorama"], row["azimuth_deg"], row["altitude_deg"])
    spot, plane = row["luminance_cdm2"], row["illuminance_lx"]
    if (spot is None) == (plane is None):
        finding = f"{at.x:g}/{at.y:g} deg has {'neither' if spot is None else 'both'}"
        raise InputError(path, finding, "luminance_cdm2 or illuminance_lx", "correct that line")
    kind, u_image = "spot" if plane is None else "illuminance", 0.0
    if plane is None:
        image, u_image = spot_cdm2(picture, at.x, at.y, at.path)
    else:
        front = fit_steps.pixels_within(picture, at.x, at.y, 90.0)
        place = f"in front of the plane at azimuth {at.x:g}, altitude {at.y:g} deg"
        _refuse_clipped(picture, front, at.path, place)
        light, heading_deg = picture.luminance_cdm2, picture.heading_deg
        image = illuminance_lx(light, heading_deg, at.y, at.x, picture.sun)
        uniform = picture.seen.astype(float)  # gives pi lx in full view
        seen = illuminance_lx(uniform, heading_deg, at.y, at.x) / math.pi
        if seen < FULLY_SEEN_SHARE:
            finding = f"no lens saw {100 * (1 - seen):.0f} % of what lights the plane, {place}"
            remedy = "remove this reading, or state luminances of places that a lens saw"
            raise InputError(at.path, finding, "a plane in full view", remedy)
    u_rel, label = math.hypot(row["u_rel"], u_image), f"{at.path.stem} {at.x:g}/{at.y:g} deg"
    meter = float(spot or plane or 0.0)
    return LuminanceReading(
        kind, label, meter=meter, image=image * to_k, u_rel=u_rel, u_image=u_image, place=at
    )


def _to_k(file: Path, picture: Panorama, profile: CameraProfile) -> float:
    """Return the profile's k divided by the k with which the picture was merged."""
    stored = picture.attributes.get("k", calibration_mark(profile)["k"])
    with input_errors(file, "a number above 0", "merge it again (fieldlum merge)", ValueError):
        if 0.0 < (k := float(stored)) < math.inf:
            return profile.scale.k / k
        raise ValueError(f"the stored factor k is '{stored}'")


def _refuse_clipped(picture: Panorama, inside: Mask, file: Path | str, place: str) -> None:
    """Raise InputError if a pixel of the mask `inside` [H, W] is clipped in every frame.

    file, place: where the pixels are, for the error.
    """
    if fit_steps.is_flagged(picture, inside, Flag.CLIPPED_HIGH):
        finding = f"the picture is clipped in every frame {place}"
        remedy = "remove this reading, or capture shorter exposures as well"
        raise InputError(file, finding, "light without clipping", remedy)


def spot_cdm2(
    picture: Panorama, azimuth_deg: float, altitude_deg: float, file: Path | str = "picture"
) -> tuple[float, float]:
    """Return a picture's mean luminance [cd/m2] over a spot meter's field, and its relative u.

    The tenth of the pixels with the smallest and the tenth with the largest values do not count.

    The field is a disc of 1 degree diameter around the direction, at least a few pixels wide.
    azimuth_deg: clockwise from north; file: for errors. Raises InputError for a place that is
    clipped or without light.
    """
    from scipy.stats import trim_mean

    place = f"at azimuth {azimuth_deg:g}, altitude {altitude_deg:g} deg"
    inside = fit_steps.pixels_within(picture, azimuth_deg, altitude_deg, fit_steps.SPOT_DEG)
    _refuse_clipped(picture, inside, file, place)
    values = np.asarray(picture.luminance_cdm2, float)[inside]
    values = values[np.isfinite(values)]
    if not len(values) or values.max() <= 0:
        remedy = "check the reading's azimuth (clockwise from north) and altitude (up)"
        raise InputError(file, f"the picture has no light {place}", "light", remedy)
    spread = float(values.std() / values.mean() / np.sqrt(len(values)))
    return float(trim_mean(values, 0.1)), spread


def fit(
    readings: list[LuminanceReading],
    meter_u: float = fit_steps.READING_U,
    source: Path | str = "scale",
) -> ScaleFit:
    """Fit one factor on k by weighted least squares of ln(meter / picture) with Huber weights.

    meter_u: relative standard uncertainty of the meter's calibration, common to all readings, part
    of u(k); source: the csv, for errors. A reading is an outlier if it differs by more than three
    u_rel and by more than 10 %. Raises NotEnoughDataError without readings, InputError if a reading
    is not positive, or if more than a third of them are outliers.
    """
    fit_steps.require(len(readings), 1, f"{source}: readings", "add a line to the csv")
    meter, image, u = np.array([(r.meter, r.image, r.u_rel) for r in readings], float).T
    bad = readings[int(np.argmin(np.minimum(meter, image)))]
    if min(bad.meter, bad.image) <= 0:
        finding = f"the meter reads {bad.meter:g}, the picture {bad.image:g} ({bad.kind})"
        raise InputError(bad.label, finding, "values above zero", "remove it from the csv")
    log_ratio, n = np.log(meter / image), len(readings)
    centre, weight = _huber_mean(log_ratio, u)
    is_outlier = np.abs(log_ratio - centre) > np.maximum(3.0 * u, MIN_OUTLIER)
    far = tuple(r.label for r, is_far in zip(readings, is_outlier, strict=True) if is_far)
    if len(far) > len(readings) / 3:  # the picture is wrong and not the readings
        finding = f"{len(far)} of {n} readings differ from the fitted k by over 10 % and 3 u"
        remedy = "check azimuths (clockwise from north), one unit for all, and steady light"
        raise InputError(source, f"{finding}: {listed(far, 4)}", "at most a third", remedy)
    scatter = float((weight * (log_ratio - centre) ** 2).sum() / max(n - 1, 1))
    u_rel = math.hypot(math.sqrt(max(scatter, 1.0) / weight.sum()), meter_u)
    line = "scale: one factor from one reading; no held-out error, which needs two readings"
    if n > 1:
        others = [_huber_mean(np.delete(log_ratio, i), np.delete(u, i))[0] for i in range(n)]
        rms_percent = 100 * float(np.sqrt(np.mean((log_ratio - others) ** 2)))
        line = f"scale: one factor; held-out rms: {rms_percent:.3g} %"
    return ScaleFit(math.exp(centre), u_rel, np.exp(log_ratio - centre) - 1.0, far, line)


def _huber_mean(values: Floats, u: Floats) -> tuple[float, Floats]:
    """Return the Huber mean of values [n] with standard uncertainties u [n], and the weights [n].

    Values over two u from the mean have less weight than 1 / u^2.
    """
    from scipy.optimize import least_squares

    start = float(np.median(values))
    solved = least_squares(lambda mean: (values - mean[0]) / u, start, loss="huber", f_scale=2.0)
    off = np.abs(solved.fun)  # distances from the mean, in u
    return float(solved.x[0]), np.minimum(1.0, 2.0 / np.maximum(off, 1e-12)) / u**2


def outlier_texts(readings: list[LuminanceReading], scale_fit: ScaleFit) -> list[str]:
    """Return a text on each outlier with its ratio to the corrected picture; empty without any."""
    return [
        f"{r.label}: the reading of {r.meter:g} is {r.meter / (r.image * scale_fit.factor):.3g} "
        f"times the picture's value: check its unit ({_UNITS}) and its decimal point"
        for r in readings
        if r.label in scale_fit.far
    ]


def check_level(scale_fit: ScaleFit, profile: CameraProfile, path: Path) -> str:
    """Return a warning if the fitted k times the sum of y_from_rgb is not 0.5 to 2, else "".

    Cameras have products in this range, whose limits are chosen. path: the csv of readings, for the
    error. Raises InputError if k also differs from the profile's k by more than a factor of ten,
    either way.
    """
    level = profile.scale.k * scale_fit.factor * sum(profile.colour.y_from_rgb)
    if 0.5 <= level <= 2.0:
        return ""
    warning = f"the factor k, summed over R, G and B, would be {level:.3g}; cameras have 0.5 to 2"
    remedy = f"check the units ({_UNITS})"
    if not 0.1 <= scale_fit.factor <= 10.0:  # another unit
        finding = f"{warning}; this is {scale_fit.factor:.3g} times the profile's k"
        remedy += "; for a filter or another white_dn, first write a k near it under [scale]"
        raise InputError(path, finding, "readings in cd/m2 and lx", remedy)
    return f"{warning}: {remedy}"


def chart(readings: list[LuminanceReading], fit: ScaleFit) -> Chart:
    """Return a chart of the meter's readings, and of the picture's values after the fit."""
    meter, image = np.array([(r.meter, r.image * fit.factor) for r in readings]).T
    title = f"scale: k times {fit.factor:.4f}, u {100 * fit.u_rel:.1f} %"
    places = [r.place for r in readings if r.place]
    return Chart(title, fit.residual, places, y=("meter [cd/m2 or lx]", meter), fitted=image)
