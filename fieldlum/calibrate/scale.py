"""The absolute factor k from spot luminances and illuminances, with its uncertainty and every
reading's residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.model_selection import Candidate, OrderSelection, choose
from fieldlum.calibrate.readings_csv import needed, read_table
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.images import calibration_mark
from fieldlum.photometry import illuminance_lx
from fieldlum.profiles import CameraProfile
from fieldlum.projection import direction, equirect_rays
from fieldlum.records import Flag, Panorama
from fieldlum.session.panorama_sun import read_panorama_with_sun

SPOT_DEG = 0.5  # half of a spot meter's field of 1 degree
METER_U = 0.02  # relative, common to all readings of one meter: its calibration
READING_U = 0.02  # of a single reading: aiming, flicker, a passing cloud
FAR = 3.0  # readings further off than this many u count less, and are named
FAR_LEAST = 0.1  # relative, and no less than this
MOST_FAR = 1 / 3  # of the readings: with more of them it is not the readings that are wrong
UNEVEN = 0.1  # relative u of a spot's mean: an edge runs through it
SENSIBLE_K = 0.5, 2.0  # k (R + G + B) of cameras whose white_dn is their white, without a filter
WILDEST = 10.0  # factor on a profile's k: more is another unit
SLIPS = {
    1 / 3.426: "fL typed for cd/m2",
    1 / 10.764: "fc typed for lx",
    1e-3: "thousands typed for ones",
    1e3: "ones typed for thousands",
    0.1: "a factor of ten",
    10.0: "a factor of ten",
}
_LIKE = 0.06  # relative, of a slip's factor


@dataclass(frozen=True, slots=True)
class LuminanceReading:
    """One comparison: what the meter read and what the picture says there, in the same unit."""

    kind: str  # spot or illuminance
    label: str
    meter: float
    image: float
    u_rel: float


@dataclass(frozen=True, slots=True)
class ScaleFit:
    factor: float  # multiplies the profile's k
    u_rel: float
    residual: NDArray[np.float64]  # meter over corrected image, less one, [n]
    far: tuple[str, ...]
    choice: OrderSelection


def from_table(
    path: Path, profile: CameraProfile
) -> tuple[list[LuminanceReading], list[Path], tuple[str, ...]]:
    """Readings from a csv: panorama, azimuth_deg, altitude_deg, and luminance_cdm2 or
    illuminance_lx; u_rel optional.

    Azimuth clockwise from north. A spot is the trimmed mean over 1 degree; an illuminance that of
    the plane that looks there. What pictures say is brought to the profile's k, whichever k they
    were merged with. Returns readings, pictures and notes. Raises InputError for both or neither in
    a line, and for pictures of another calibration.
    """
    rows = read_table(
        path,
        ("panorama", "azimuth_deg", "altitude_deg"),
        ("luminance_cdm2", "illuminance_lx", "u_rel"),
    )
    files = dict.fromkeys(needed(row, "panorama", path) for row in rows)
    pictures = {file: read_panorama_with_sun(file) for file in files}
    to_k = {file: _to_k(file, picture, profile) for file, picture in pictures.items()}
    found = []
    for row in rows:
        azimuth, altitude = needed(row, "azimuth_deg", path), needed(row, "altitude_deg", path)
        spot, plane = row.get("luminance_cdm2"), row.get("illuminance_lx")
        if (spot is None) == (plane is None):
            raise InputError(
                path, "a line with both or neither reading", "luminance_cdm2 or illuminance_lx"
            )
        file, u = row["panorama"], row.get("u_rel") or READING_U
        picture, label = pictures[file], f"{file.stem} {azimuth:g}/{altitude:g} deg"
        if spot is not None:
            image, u_image = spot_cdm2(picture, azimuth, altitude, file)
            found.append(
                LuminanceReading(
                    "spot", label, spot, image * to_k[file], float(np.hypot(u, u_image))
                )
            )
        else:
            image = _plane_lx(picture, azimuth, altitude, file)
            found.append(
                LuminanceReading("illuminance", label, plane or 0.0, image * to_k[file], u)
            )
    unmarked = [file.name for file, picture in pictures.items() if "k" not in picture.attributes]
    notes = (
        f"{', '.join(unmarked)} does not say with which k it was merged: taken for the profile's",
    ) * bool(unmarked)
    uneven = [r.label for r in found if r.u_rel > np.hypot(UNEVEN, READING_U)]
    notes += (
        f"an edge runs through {', '.join(uneven)}: counted little; read places even over two "
        f"degrees",
    ) * bool(uneven)
    return found, list(pictures), notes


def _to_k(file: Path, picture: Panorama, profile: CameraProfile) -> float:
    """The profile's k over the one that the picture was merged with. Raises InputError for
    another calibration.
    """
    known, own = picture.attributes, calibration_mark(profile)
    if known.get("calibration", own["calibration"]) != own["calibration"]:
        found = (
            f"merged with {known.get('camera', 'a profile')} of another calibration (lens, "
            f"sensor, response, colour)"
        )
        raise InputError(
            file,
            found,
            f"{profile.camera.name} as it stands",
            "merge it again with --camera's profile",
        )
    try:
        return profile.scale.k / float(known.get("k", own["k"]))
    except (ValueError, ZeroDivisionError):
        raise InputError(
            file, f"k '{known['k']}' in it", "a number above 0", "merge it again"
        ) from None


def _inside(
    picture: Panorama, azimuth_deg: float, altitude_deg: float, radius_rad: float
) -> NDArray[np.bool_]:
    height, width = picture.luminance_cdm2.shape
    rays = equirect_rays(height, width, picture.heading_deg)
    return rays @ direction(altitude_deg, azimuth_deg) >= np.cos(radius_rad)


def _refuse_clipped(
    picture: Panorama, inside: NDArray[np.bool_], file: Path | str, place: str, remedy: str
) -> None:
    if picture.flags is not None and (picture.flags[inside] & Flag.CLIPPED_HIGH).any():
        raise InputError(
            file, f"clipped in every frame {place}", "light that a frame holds", remedy
        )


def _plane_lx(picture: Panorama, azimuth_deg: float, altitude_deg: float, file: Path) -> float:
    """Raises InputError where something in front of the plane is a lower bound only."""
    front = _inside(picture, azimuth_deg, altitude_deg, np.pi / 2)
    place = (
        f"in front of {azimuth_deg:g}/{altitude_deg:g} deg (sun or lamp): an unknown part of "
        f"the illuminance"
    )
    _refuse_clipped(picture, front, file, place, "leave this line out, or take shorter frames too")
    return illuminance_lx(
        picture.luminance_cdm2, picture.heading_deg, altitude_deg, azimuth_deg, picture.sun
    )


def spot_cdm2(
    picture: Panorama, azimuth_deg: float, altitude_deg: float, file: Path | str = "picture"
) -> tuple[float, float]:
    """Trimmed mean over the meter's field, at least a few pixels, and its relative spread.
    Raises InputError.
    """
    from scipy.stats import trim_mean

    place = f"at {azimuth_deg:g}/{altitude_deg:g} deg"
    inside = _inside(
        picture,
        azimuth_deg,
        altitude_deg,
        np.radians(max(SPOT_DEG, 1.2 * 180.0 / len(picture.luminance_cdm2))),
    )
    _refuse_clipped(picture, inside, file, place, "read a darker place, or take shorter frames too")
    values = np.asarray(picture.luminance_cdm2, float)[inside]
    values = values[np.isfinite(values)]
    if not len(values) or values.max() <= 0:
        remedy = "azimuth counts clockwise from north, altitude up from the horizon"
        raise InputError(file, f"no light {place}", "a place that it shows", remedy)
    spread = float(values.std() / values.mean() / np.sqrt(len(values)))
    return float(trim_mean(values, 0.1)), spread


def fit(
    readings: list[LuminanceReading], meter_u: float = METER_U, source: Path | str = "scale"
) -> ScaleFit:
    """k by weighted least squares of ln(meter / image) with Huber weights; u(k) holds the meter's
    own u.

    A second model with an offset (stray light) is tried on held-out readings; it is never put into
    the profile, but said. Raises NotEnoughDataError without readings, InputError for readings that
    are not positive, or that contradict each other so often that no one factor is right.
    """
    if not readings:
        raise NotEnoughDataError("no readings: one spot or one vertical illuminance is the least")
    meter, image, u = (
        np.array([getattr(r, name) for r in readings], float)
        for name in ("meter", "image", "u_rel")
    )
    if not ((meter > 0).all() and (image > 0).all()):
        bad = readings[int(np.argmin(np.minimum(meter, image)))]
        raise InputError(
            bad.label, f"meter {bad.meter:g}, image {bad.image:g}", "readings above zero"
        )
    log = np.log(meter / image)
    centre, weight = _centre(log, u)
    off = np.abs(log - centre) / np.maximum(u, FAR_LEAST / FAR)
    scatter = float((weight * (log - centre) ** 2).sum() / max(len(log) - 1, 1))
    u_log = np.sqrt(max(scatter, 1.0) / weight.sum())
    far = tuple(r.label for r, o in zip(readings, off, strict=True) if o > FAR)
    if len(far) > MOST_FAR * len(log):
        found = (
            f"{len(far)} of {len(log)} readings are far off any one factor: {', '.join(far[:4])}"
        )
        remedy = (
            "azimuth counts clockwise from north, one unit for all, steady light; then merge again"
        )
        raise InputError(source, found, "readings that agree", remedy)
    spots = np.array([r.kind == "spot" for r in readings])
    choice = _choice(meter, image, u, log, spots)
    residual = meter / (image * np.exp(centre)) - 1.0
    return ScaleFit(float(np.exp(centre)), float(np.hypot(u_log, meter_u)), residual, far, choice)


def slips(readings: list[LuminanceReading], found: ScaleFit) -> list[str]:
    """What may have been typed wrong: readings off by a factor that units or a decimal point
    make.
    """
    said = []
    for reading in readings:
        if reading.label in found.far:
            ratio = reading.meter / (reading.image * found.factor)
            said.append(
                f"{reading.label}: {reading.meter:g} is {ratio:.3g} times the "
                f"picture's{_slip(ratio)}"
            )
    return said


def _slip(ratio: float) -> str:
    return next(
        (f" ({name}?)" for factor, name in SLIPS.items() if abs(ratio / factor - 1) < _LIKE), ""
    )


def check_level(found: ScaleFit, profile: CameraProfile, path: Path) -> str:
    """A doubt about k as a whole, or "". Raises InputError for a k that no camera with such a
    profile can have.
    """
    level = profile.scale.k * found.factor * sum(profile.colour.y_from_rgb)
    low, high = SENSIBLE_K
    if low <= level <= high:
        return ""
    doubt = f"k (R + G + B) would be {level:.3g}, where cameras have {low:g} to {high:g}"
    remedy = (
        "check that readings are in cd/m2 and lx (1 fL = 3.426 cd/m2, 1 fc = 10.76 lx, 1 klx "
        "= 1000 lx)"
    )
    if not 1 / WILDEST <= found.factor <= WILDEST:
        remedy += (
            "; if a filter on the lens or white_dn makes it so, first write a k near it "
            "under [scale]"
        )
        raise InputError(
            path,
            f"{doubt}; {found.factor:.3g} times the profile's k",
            "readings in cd/m2 and lx",
            remedy,
        )
    return f"{doubt}: {remedy}"


def _centre(log: NDArray[np.float64], u: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    weight = 1.0 / u**2
    centre = float(np.median(log))
    for _ in range(30):
        pull = np.abs(log - centre) / u
        weight = 1.0 / u**2 * np.minimum(1.0, 2.0 / np.maximum(pull, 1e-12))
        centre = float((weight * log).sum() / weight.sum())
    return centre, weight


def _choice(
    meter: NDArray[np.float64],
    image: NDArray[np.float64],
    u: NDArray[np.float64],
    log: NDArray[np.float64],
    spots: NDArray[np.bool_],
) -> OrderSelection:
    """One factor, or a factor and an offset, on spots left out one by one."""
    n = len(log)
    if n < 2:
        return OrderSelection(0, "scale: one reading, one factor: nothing to hold out")
    plain = (
        np.array([log[i] - _centre(np.delete(log, i), np.delete(u, i))[0] for i in range(n)]) ** 2
    )
    candidates = [Candidate("one factor", 1, plain)]
    if spots.sum() >= 5 and spots.all():
        errors = [
            _offset_error(
                np.delete(meter, i), np.delete(image, i), np.delete(u, i), meter[i], image[i]
            )
            for i in range(n)
        ]
        candidates.append(Candidate("factor and offset", 2, np.array(errors)))
    return choose("scale", candidates)


def _offset_error(
    meter: NDArray[np.float64],
    image: NDArray[np.float64],
    u: NDArray[np.float64],
    held: float,
    held_image: float,
) -> float:
    a = np.stack([image, np.ones_like(image)], axis=1) / (u * meter)[:, None]
    slope, offset = np.linalg.lstsq(a, 1.0 / u, rcond=None)[0]
    return float(np.log(max(slope * held_image + offset, 1e-3 * held) / held) ** 2)
