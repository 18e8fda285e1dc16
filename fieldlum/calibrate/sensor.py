"""Fit the linearity of a raw sensor, and find its hot and stuck pixels.

A linear sensor gives counts in proportion to time. Real sensors deviate by about one percent (a
12-bit CCD of EMVA1288/datasets: +0.3 to -1.2 %). Frames of a steady light show it. The shutter's
constant offset is fitted together with the curve, because an electronic shutter opens some
microseconds longer than stated: without the offset the darkest frames would bend the curve.

Hot and stuck pixels deviate from their neighbours of the same colour in all dark frames. If good
pixels would do so by chance, there is no result. A dead pixel is dark like the others; a merge
averages it with its neighbours.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place
from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.optics.camera_curves import linearity_factor
from fieldlum.optics.linear_light import black_dn, full_dn, gain_e_per_dn, true_shutter_s
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.raw import Mosaic, channel_positions, frame_files


class PixelDefects(NamedTuple):
    """The bad pixels of a sensor, and the evidence for them.

    bad_px: column and row of each; frames: the frames that were read; line: text for the profile.
    """

    bad_px: tuple[tuple[int, int], ...]
    frames: tuple[Path, ...]
    line: str


def find(sources: Sequence[Path], profile: CameraProfile) -> PixelDefects:
    """Find the bad pixels of a raw camera in frames with the cap on.

    sources: frames, or folders of frames. Raises InputError for frames that are not raw frames of
    this camera, and for a frame with light; NotEnoughDataError for fewer than two frames, or if too
    many pixels deviate.
    """
    if profile.camera.kind != "raw":
        remedy = "use the camera's raw files"
        raise InputError(profile.camera.name, "a JPEG camera", "a raw camera", remedy)
    frames = tuple(frame_files(*sources))
    fit_steps.require(len(frames), 2, "bad pixels: dark frames", "take more with the cap on")
    deviating = [_deviating(path, profile) for path in frames]
    pixels, times = np.unique(np.concatenate(deviating), return_counts=True)
    bad = pixels[times == len(frames)]
    share = float(np.mean([len(px) for px in deviating])) / profile.camera.pixels
    by_chance = profile.camera.pixels * share ** len(frames)
    line = (
        f"bad pixels: {len(bad)}, which deviate from their neighbours in each of {len(frames)} "
        f"dark frames; {by_chance:.2g} good pixels would do so by chance"
    )
    if by_chance > 0.5:
        raise NotEnoughDataError(f"{line}; expected under 0.5; take more dark frames")
    if len(bad) > 1e-3 * profile.camera.pixels:  # such a list is not one of defects
        remedy = "check gain and read noise under [sensor] in the profile"
        raise NotEnoughDataError(f"{line}; expected at most 0.1 % of all; {remedy}")
    rows, columns = np.unravel_index(bad, (profile.camera.height_px, profile.camera.width_px))
    return PixelDefects(tuple(zip(columns.tolist(), rows.tolist(), strict=True)), frames, line)


def _deviating(path: Path, profile: CameraProfile) -> Indices:
    """Return the pixels of a dark frame that deviate from the median of their neighbourhood.

    They are flat indices into the mosaic [n]. The neighbourhood is the pixel and the eight next to
    it of the same colour. A pixel deviates if it differs by more than each of these: six times the
    noise, four times the spread of the neighbourhood. Raises InputError if light reached the frame.
    """
    import cv2

    mosaic = fit_steps.own_mosaic(path, profile)
    far = np.zeros(mosaic.counts.shape, bool)
    gain = gain_e_per_dn(mosaic.exposure.iso, profile)
    read_dn = profile.sensor.read_noise_e / gain
    planes = zip(channel_positions(mosaic.cfa), black_dn(mosaic, profile), strict=True)
    for (row, column), black in planes:
        counts = np.ascontiguousarray(mosaic.counts[row::2, column::2])
        above = float(np.percentile(counts[::4, ::4], 90)) - black
        if above > max(5 * np.hypot(read_dn, 1.0), 0.01 * (profile.sensor.white_dn - black)):
            finding, remedy = f"{above:.0f} DN above the black level", "put the lens cap on"
            raise InputError(path, finding, "a dark frame, without light", remedy)
        middle = np.asarray(cv2.medianBlur(counts, 3), np.uint16)
        off = cv2.absdiff(counts, middle)
        light_dn2 = np.maximum(middle - black, 0.0) / gain
        noise = np.sqrt(light_dn2 + read_dn**2 + 1 / 12)
        far[row::2, column::2] = off > np.maximum(6.0 * noise, 4.0 * cv2.medianBlur(off, 3))
    return np.flatnonzero(far)


def pixel_chart(defects: PixelDefects) -> Chart:
    """Return a chart of the bad pixels over a dark frame."""
    places = [Place(defects.frames[0], x + 0.5, y + 0.5) for x, y in defects.bad_px]
    return Chart(f"{len(places)} bad pixels", np.zeros(len(places)), places)


ORDERS = range(5)  # of the polynomials that are tried
MIN_TIMES = len(ORDERS) + 1  # the coefficients of the highest order, an offset and one more
# shares of the full scale: frames must reach below the first and above the second; chosen
_DARK_SHARE, _BRIGHT_SHARE = 0.05, 0.8
_U_BLACK_DN = 0.2  # standard uncertainty of a black level; chosen
_U_LAMP_REL = 5e-4  # stability of a lamp over minutes; limits the weight of any frame; chosen


class Levels(NamedTuple):
    """The mean raw counts of blocks of each frame, to which linearity is fitted.

    A block is one of 8 x 8 equal rectangles of a frame, in one of R, G1, G2 and B. share: mean
    counts above black divided by the full scale, [frames, blocks], NaN where a block is saturated
    or dark; weight: 1 / (relative uncertainty of the share)^2, [frames, blocks]; seconds: true
    shutter times by the profile, [frames].
    """

    share: Floats
    weight: Floats
    seconds: Floats
    frames: tuple[Path, ...]


class LinearityFit(NamedTuple):
    """A fitted linearity.

    coefficients: (a1, a2, ...) of the factor 1 + a1 x + a2 x^2 + ... that corrects the counts above
    black, with x their share of the full scale. offset_s: constant to add to the shutter times of
    `Levels` [s]; 0 unless it exceeds four standard errors. u_offset_s: its standard error [s].
    u_rel: relative held-out rms of the light, at least 5e-4.
    """

    coefficients: tuple[float, ...]
    offset_s: float
    u_offset_s: float
    u_rel: float
    choice: fit_steps.OrderSelection


def read_levels(paths: Sequence[Path], profile: CameraProfile) -> Levels:
    """Read raw frames of one steady scene with many exposure times, as means over blocks.

    A frame has 8 x 8 blocks for each of R, G1, G2 and B. Raises InputError for a frame that cannot
    be read, is of another camera, or has another aperture or ISO than the first.
    """
    blocks, settings, seconds = [], [], []
    for path in paths:
        mosaic = fit_steps.own_mosaic(path, profile)
        settings.append(f"f/{mosaic.exposure.f_number:g} and ISO {mosaic.exposure.iso:g}")
        if settings[-1] != settings[0]:
            raise InputError(path, settings[-1], f"{settings[0]} as before", "leave it out")
        blocks.append(_blocks(mosaic, profile))
        seconds.append(true_shutter_s(mosaic.exposure.shutter_s, profile)[0])
    share, weight = np.array(blocks).transpose(1, 0, 2)
    return Levels(share=share, weight=weight, seconds=np.array(seconds), frames=tuple(paths))


def _blocks(mosaic: Mosaic, profile: CameraProfile) -> Floats:
    """Return mean counts as shares of the full scale in a frame's blocks, and weights, [2, blocks].

    The mean is NaN where a block is saturated or dark. A weight is 1 / (relative uncertainty)^2.
    """
    parts = []
    levels = zip(black_dn(mosaic, profile), full_dn(mosaic, profile), strict=True)
    for (row, column), (black, top) in zip(channel_positions(mosaic.cfa), levels, strict=True):
        cell = mosaic.counts[row::2, column::2].astype(float)
        rows, columns = (n // 8 for n in cell.shape)  # of a block
        blocks = cell[: 8 * rows, : 8 * columns].reshape(8, rows, 8, columns)
        pixels = blocks.transpose(0, 2, 1, 3).reshape(64, -1)  # [blocks, pixels]
        mean = pixels.mean(axis=1) - black
        u_dn = np.hypot(pixels.std(axis=1) / np.sqrt(pixels.shape[1]), _U_BLACK_DN)
        lowest_dn, clipped_dn = 25 * _U_BLACK_DN, black + fit_steps.CLIPPED_SHARE * (top - black)
        good = (pixels.max(axis=1) < clipped_dn) & (mean > lowest_dn)
        share = np.where(good, mean, np.nan) / (profile.sensor.white_dn - black)
        parts.append((share, 1.0 / (_U_LAMP_REL**2 + (u_dn / np.maximum(mean, lowest_dn)) ** 2)))
    return np.concatenate(parts, axis=1)


def fit(levels: Levels) -> LinearityFit:
    """Fit linearity and shutter offset; held-out exposure times choose the order of the curve.

    Raises NotEnoughDataError for fewer than six times, or for frames without the dark or the bright
    part of the scale.
    """
    times = np.unique(levels.seconds)
    low, high = np.nanmin(levels.share, initial=1.0), np.nanmax(levels.share, initial=0.0)
    if len(times) < MIN_TIMES or low > _DARK_SHARE or high < _BRIGHT_SHARE:
        raise NotEnoughDataError(
            f"shutter times: {len(times)}, with {100 * low:.0f} to {100 * high:.0f} % of white; "
            f"expected at least {MIN_TIMES}, with under {100 * _DARK_SHARE:.0f} to over "
            f"{100 * _BRIGHT_SHARE:.0f} %; take more frames of a steady light"
        )
    _, (solution, covariance), choice = fit_steps.fit_and_choose(
        "linearity",
        [(f"order {order}", order, order) for order in ORDERS],
        np.searchsorted(times, levels.seconds),
        lambda order, rows: _solve(levels, rows, order),
        lambda order, solved, held: _held_out(levels, solved[0], held),
        negligible=0.04 * _U_LAMP_REL,
    )
    u_offset = float(np.sqrt(covariance[0, 0]))
    is_sure = abs(solution[0]) > 4.0 * u_offset
    return LinearityFit(
        tuple(round(float(a), 7) for a in solution[1:]),
        offset_s=float(f"{solution[0]:.4g}") if is_sure else 0.0,
        u_offset_s=u_offset,
        u_rel=max(round(choice.rms, 5), _U_LAMP_REL),
        choice=choice,
    )


def _residuals(solution: Floats, levels: Levels, fitted: Mask, judged: Mask) -> Floats:
    """Return ln(corrected light / time) of the judged frames, minus each block's mean, [j, blocks].

    The mean is over the `fitted` frames. solution: offset of the exposure times [s], then the
    polynomial's coefficients; fitted, judged: masks of the frames, j of which are judged.
    """
    with np.errstate(invalid="ignore"):
        light = np.log(levels.share * linearity_factor(levels.share, tuple(solution[1:])))
    off = light - np.log(levels.seconds + solution[0])[:, None]
    weight = np.where(np.isfinite(levels.share), levels.weight, 0.0)[fitted]
    total = weight.sum(axis=0)
    mean = (np.nan_to_num(off[fitted]) * weight).sum(axis=0)
    return (off - np.divide(mean, total, out=np.full(len(total), np.nan), where=total > 0))[judged]


def _solve(levels: Levels, rows: Mask, order: int) -> tuple[Floats, Floats]:
    """Fit offset [s] and coefficients to the frames `rows`; return them, and their covariance.

    They are found by weighted least squares from a linear sensor without an offset. order: highest
    power of the polynomial.
    """
    from scipy.optimize import least_squares

    scale = np.r_[levels.seconds.min(), np.ones(order)]  # the offset in units of the shortest time
    good = np.isfinite(levels.share[rows])
    root = np.sqrt(levels.weight[rows][good])

    def misses(x: Floats) -> Floats:
        """Return the weighted residuals of all good blocks; x: the solution over `scale`."""
        return _residuals(x * scale, levels, rows, rows)[good] * root

    lowest = np.r_[-0.5, np.full(order, -np.inf)]  # exposure times must stay above zero
    solved = least_squares(misses, np.zeros(1 + order), bounds=(lowest, np.inf))
    freedom = max(len(root) - levels.share.shape[1] - 1 - order, 1)
    covariance = np.linalg.pinv(solved.jac.T @ solved.jac) * 2.0 * solved.cost / freedom
    return solved.x * scale, covariance * np.outer(scale, scale)


def _held_out(levels: Levels, solution: Floats, held: Mask) -> Floats:
    """Return the squared relative error of predicting each frame from the other exposure times.

    The shortest and the longest time are NaN, because that would be extrapolation. Blocks count by
    their weights, so that noise in dark frames does not decide. solution: offset and coefficients
    by `_solve`; held: mask of the frames to predict.
    """
    residuals = _residuals(solution, levels, ~held, held)
    weight = np.where(np.isfinite(residuals), levels.weight[held], 0.0)
    total, seconds = weight.sum(axis=1), levels.seconds[held]
    square = (np.nan_to_num(residuals) ** 2 * weight).sum(axis=1)
    within = (seconds > levels.seconds.min()) & (seconds < levels.seconds.max()) & (total > 0)
    return np.divide(square, total, out=np.full(len(total), np.nan), where=within)


def chart(levels: Levels, fit: LinearityFit) -> Chart:
    """Return a chart of each block's light per exposure time, recorded (red) and corrected (blue).

    The x axis is the block's mean count as a share of the full scale in %; the y axis is light
    divided by exposure time, relative to the mean over the block's frames. There is one point for
    each frame and block (see `Levels`).
    """
    light = levels.share[:, np.isfinite(levels.share).any(axis=0)]  # a block may be full throughout
    corrected = light * linearity_factor(light, fit.coefficients)
    logs = []
    for value, offset_s in ((light, 0.0), (corrected, fit.offset_s)):
        log = np.log(value / (levels.seconds[:, None] + offset_s))
        logs.append((log - np.nanmean(log, axis=0)).ravel())
    good = np.isfinite(logs[0])
    share, (before, after) = 100 * light.ravel()[good], (log[good] for log in logs)
    x, y = ("share of the full scale [%]", share), ("light over time", np.exp(before))
    return Chart(f"Linearity; held-out rms {100 * fit.u_rel:.2g} %", after, (), x, y, np.exp(after))
