"""Three numbers from camera colours to luminance: the maker's own, moved by readings as far as
they prove it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.chart import CHART_Y, find_chart, in_order, patch_centres
from fieldlum.calibrate.frames import LinearFrame, linear_frame, nearest_lens, transmission
from fieldlum.calibrate.model_selection import Candidate, OrderSelection, choose
from fieldlum.calibrate.readings_csv import needed, read_table
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.profiles import CameraProfile
from fieldlum.statistics import robust_sigma

Array = NDArray[np.floating]
READING_U = 0.02
PULLS = ((1.0, "near the prior"), (0.1, "half-way"), (0.01, "mostly the readings"), (1e-4, "free"))
LEAST = 4
# of ln luminance over what the best start says: a reading further off, and alone, is a slip
FAR = 0.5
MOST_U = 0.2  # a larger held-out error is no set of coefficients
CHART_U = 0.03  # of a printed chart's patch


@dataclass(frozen=True, slots=True)
class Colours:
    """rgb [n, 3] camera colours, y [n] luminances in any one unit, u_rel [n], labels."""

    rgb: Array
    y: Array
    u_rel: Array
    labels: tuple[str, ...]
    frames: tuple[Path, ...]
    matrix: Array | None = None  # XYZ to camera, where the frames know it


@dataclass(frozen=True, slots=True)
class ColourFit:
    y_from_rgb: tuple[float, float, float]
    scale: float  # luminance over a . rgb with the new figures: what k would be multiplied by
    u_rel: float  # rms of the held-out errors
    residual: Array
    choice: OrderSelection


# ----------------------------------------------------------------------------------------------
# readings


def from_table(path: Path, profile: CameraProfile) -> Colours:
    """Spot readings: file, x_px, y_px, luminance_cdm2; optional radius_px (12), u_rel.
    Vignetting is taken out.
    """
    rows = read_table(path, ("file", "x_px", "y_px", "luminance_cdm2"), ("radius_px", "u_rel"))
    frames: dict[Path, LinearFrame] = {}
    rgb, y, u, labels = [], [], [], []
    for row in rows:
        file, x, at = (
            needed(row, "file", path),
            needed(row, "x_px", path),
            needed(row, "y_px", path),
        )
        frame = frames.setdefault(file, linear_frame(file, profile))
        patch = frame.patch(x, at, row.get("radius_px") or 12.0)
        lens = profile.lens[nearest_lens(profile, x, at)]
        rgb.append(patch.rgb / transmission(lens, frame.exposure.f_number, x, at))
        y.append(needed(row, "luminance_cdm2", path))
        u.append(float(np.hypot(row.get("u_rel") or READING_U, patch.u_rel)))
        labels.append(f"{file.stem} {x:g},{at:g}")
    matrix = next((f.colour_matrix for f in frames.values() if f.colour_matrix is not None), None)
    return Colours(np.array(rgb), np.array(y), np.array(u), tuple(labels), tuple(frames), matrix)


def from_chart(path: Path, profile: CameraProfile, corners_px: Sequence[float] = ()) -> Colours:
    """A 24-patch chart in a frame, evenly lit: found in it, or by its four outer patch-field
    corners.

    corners_px: x, y of the top left (dark skin), top right, bottom right (black) and bottom left
    corner. Raises InputError where no chart is found, or where the corners are given in another
    order.
    """
    frame = linear_frame(path, profile)
    centres, radius = (
        patch_centres(np.reshape(corners_px, (4, 2))) if len(corners_px) else find_chart(frame)
    )
    rgb, u = [], []
    for x, y in centres:
        patch = frame.patch(x, y, radius)
        rgb.append(
            patch.rgb
            / transmission(profile.lens[nearest_lens(profile, x, y)], frame.exposure.f_number, x, y)
        )
        u.append(float(np.hypot(CHART_U, patch.u_rel)))
    if not in_order(np.array(rgb) @ np.array(profile.colour.y_from_rgb)):
        found = "patches whose greys and colours come in another order than a chart's"
        raise InputError(
            path, found, "--corners from dark skin on, then clockwise", "start at the brown corner"
        )
    labels = tuple(f"patch {i + 1}" for i in range(len(CHART_Y)))
    return Colours(
        np.array(rgb), np.array(CHART_Y), np.array(u), labels, (path,), frame.colour_matrix
    )


# ---------------------------------------------------------------------------------------------- fit


def priors(colours: Colours, profile: CameraProfile) -> list[tuple[Array, str]]:
    """The profile's coefficients, and the luminance row of the frames' own matrix (camera to
    XYZ), of the same size.
    """
    of_profile = np.array(profile.colour.y_from_rgb)
    found: list[tuple[Array, str]] = [(of_profile, "the profile's coefficients")]
    if colours.matrix is not None:
        row = np.linalg.inv(colours.matrix)[1]
        grey = colours.rgb.mean(axis=0)
        found.append(
            (row * float(of_profile @ grey) / float(row @ grey), "the file's colour matrix")
        )
    return found


def fit(colours: Colours, profile: CameraProfile) -> ColourFit:
    """Ridge towards the prior; how far to leave it is chosen on readings left out one by one.

    The new coefficients give the mean colour of the readings the same luminance as the prior did:
    only their proportion is fitted here, the absolute factor belongs to `calibrate scale` and is
    returned beside. Raises NotEnoughDataError under four readings.
    """
    n = len(colours.y)
    if n < LEAST:
        raise NotEnoughDataError(
            f"{n} readings are too few for three coefficients: take at least {LEAST} colours"
        )
    if not ((colours.y > 0).all() and (colours.rgb[:, 1] > 0).all()):
        raise InputError(
            colours.frames[0],
            "readings or patches that are not positive",
            "colours that the frame holds",
        )
    every = colours
    colours, slips = _without_slips(colours, profile)
    n = len(colours.y)
    rows, each = np.arange(n), range(n)

    def candidate(prior: Array, pull: float, name: str, size: int) -> Candidate:
        errors = [
            (_predict(_solve(colours, prior, pull, rows != i), colours, i) - 1.0) ** 2 for i in each
        ]
        return Candidate(name, size, np.array(errors))

    starts = priors(colours, profile)
    candidates = [candidate(start, np.inf, name, 0) for start, name in starts]
    prior = starts[int(np.argmin([c.errors.mean() for c in candidates]))][0]
    models = [(start, np.inf) for start, _ in starts] + [(prior, pull) for pull, _ in PULLS]
    candidates += [
        candidate(prior, pull, name, size) for size, (pull, name) in enumerate(PULLS, start=1)
    ]
    choice = choose("colour", candidates)
    prior, pull = models[choice.index]
    raw = _solve(colours, prior, pull, rows >= 0)
    grey = (colours.rgb / (colours.rgb @ prior)[:, None]).mean(axis=0)
    scale = float(raw @ grey) / float(prior @ grey)
    a = raw / scale
    residual = every.rgb @ raw / every.y - 1.0
    u = float(np.sqrt(candidates[choice.index].errors.mean()))
    if u > MOST_U:
        found = (
            f"readings and colours that do not go together: held-out readings miss by "
            f"{100 * u:.0f} %"
        )
        remedy = "each line needs the place where the meter looked, under steady light"
        raise InputError(colours.frames[0], found, f"at most {100 * MOST_U:.0f} %", remedy)
    if slips:
        choice = replace(choice, line=f"{choice.line}; left out: {'; '.join(slips)}")
    return ColourFit(
        (round(float(a[0]), 6), round(float(a[1]), 6), round(float(a[2]), 6)),
        scale,
        max(u, 0.001),
        residual,
        choice,
    )


def _without_slips(colours: Colours, profile: CameraProfile) -> tuple[Colours, tuple[str, ...]]:
    """Without readings off by a factor (a decimal point, another unit), which are told; at most
    a quarter of them.
    """
    offs = [np.log((colours.rgb @ start) / colours.y) for start, _ in priors(colours, profile)]
    offs = [off - np.median(off) for off in offs]
    off = min(offs, key=lambda o: float(np.median(np.abs(o))))
    far = np.abs(off) > max(FAR, 5 * robust_sigma(off, 0.0))
    if not far.any() or far.mean() > 0.25 or len(off) - far.sum() < LEAST:
        return colours, ()
    told = [
        f"{colours.labels[i]}, {np.exp(-off[i]):.2g} times what the others make it"
        for i in np.flatnonzero(far)
    ]
    kept = replace(
        colours,
        rgb=colours.rgb[~far],
        y=colours.y[~far],
        u_rel=colours.u_rel[~far],
        labels=tuple(label for label, gone in zip(colours.labels, far, strict=True) if not gone),
    )
    return kept, tuple(told)


def _solve(colours: Colours, prior: Array, pull: float, rows: NDArray[np.bool_]) -> Array:
    """Minimise sum ((a . rgb / y - 1) / u)^2 + n pull / u^2 |share * (a - s prior)|^2, s the
    prior's own best scale.
    """
    rgb, y, u = colours.rgb[rows], colours.y[rows], colours.u_rel[rows]
    weighted = (rgb @ prior) / y / u
    s = float(weighted @ (1.0 / u) / (weighted @ weighted))
    if np.isinf(pull):
        return s * prior
    design, target = rgb / y[:, None] / u[:, None], 1.0 / u
    share = np.diag((rgb / y[:, None]).mean(axis=0) * np.sqrt(len(y) * pull) / np.median(u))
    stacked = np.concatenate([design, share]), np.concatenate([target, share @ (s * prior)])
    return np.linalg.lstsq(*stacked, rcond=None)[0]


def _predict(a: Array, colours: Colours, i: int) -> float:
    return float(colours.rgb[i] @ a / colours.y[i])
