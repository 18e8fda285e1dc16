"""Draw one picture for each fit: readings, fitted curve and residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.lens import Circle, grey_picture, level_lens
from fieldlum.calibrate.readings import Place
from fieldlum.core.arrays import Array
from fieldlum.core.plot_style import BLUE, INK, RED, open_axes
from fieldlum.optics.images import read_panorama
from fieldlum.optics.photometry import linearity_factor, response_table, vignetting_at
from fieldlum.optics.projection import equirect_pixel, lens_pixels
from fieldlum.session import replacing_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fieldlum.calibrate import (
        colour,
        lens,
        linearity,
        pixels,
        response,
        scale,
        shutter,
        stray,
        vignette,
    )


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, SVG or PDF, by suffix; the file appears complete or not at all."""
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _drawn(
    title: str,
    x: tuple[str, Array],
    y: tuple[str, Array],
    fitted: Array,
    off: Array,
    places: Sequence[Place] = (),
) -> Figure:
    """Return a figure of readings and fit (blue) over x, of residuals, and of their places.

    x, y : label and values [n], y of the readings; fitted [n] : y by the fit; off [n] : reading
    less fit, a share.
    """
    from matplotlib.figure import Figure

    count = 2 + bool(places)
    figure = Figure(figsize=(4.2 * count, 3.4), layout="constrained")
    left, right, *picture = figure.subplots(1, count)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    shown = {"linestyle": "", "markersize": 3.5, "alpha": min(1.0, 200 / max(len(off), 1))}
    left.plot(x[1], y[1], "o", color=RED, **shown)
    left.plot(x[1], fitted, ".", color=BLUE, **shown)
    xscale = "log" if x[0].endswith("[s]") else "linear"
    wide = y[1].min() > 0 and y[1].max() > 30 * y[1].min()
    left.set(xscale=xscale, yscale="log" if wide else "linear", xlabel=x[0], ylabel=y[0])
    right.plot(x[1], 100 * off, "o", color=RED, **shown)
    right.axhline(0.0, color=BLUE, linewidth=1.2)
    right.set(xscale=xscale, xlabel=x[0], ylabel="reading less fit [%]")
    for axes in (left, right):
        open_axes(axes)
    for axes in picture:
        _over(figure, axes, places, off)
    return figure


def _over(figure: Figure, axes: Any, places: Sequence[Place], off: Array) -> None:
    """Draw the picture with most of the places, and on it their residuals `off` [n], a share.

    Places of other frames are drawn too, because all frames show one sensor; those of other
    panoramas are not.
    """
    path = Counter(place.path for place in places).most_common(1)[0][0]
    is_panorama = path.suffix.lower() in (".exr", ".hdr")
    shown = np.array([place.path == path or not is_panorama for place in places])
    at = np.array([(place.x, place.y) for place in places], float)[shown]
    percent = 100 * np.asarray(off)[shown]
    if is_panorama:
        panorama = read_panorama(path)
        light = np.nan_to_num(panorama.luminance_cdm2)
        grey = np.log(np.maximum(light, 1e-3 * float(np.percentile(light, 99))))
        h, w = grey.shape
        row, column = equirect_pixel(at[:, 1], at[:, 0], h, w, panorama.heading_deg)
        at = np.stack([column, row], axis=1)
    else:
        grey = grey_picture(path)
    height, width = grey.shape
    step = max(height // 800, 1)  # the figure has fewer pixels
    axes.imshow(grey[::step, ::step], cmap="gray", extent=(0, width, height, 0))
    limit = max(float(np.abs(percent).max()), 0.1)
    style = {"edgecolors": "white", "linewidths": 0.6, "cmap": "coolwarm"}
    marks = axes.scatter(*at.T, s=26, c=percent, vmin=-limit, vmax=limit, **style)
    axes.set_title(path.name, fontsize=8, color=INK)
    axes.set_axis_off()
    if percent.any():
        figure.colorbar(marks, ax=axes, shrink=0.8, label="off [%]")


def of_response(places: response.Places, fit: response.ResponseFit) -> Figure:
    """Draw the light of the sampled places over their codes, in all colours.

    A residual is the light of a place by one frame less the mean by all frames.
    """
    r, parts = fit.response, []
    for c, curve in enumerate((r.red, r.green, r.blue)):
        table, codes = response_table(r.kind, curve), places.codes[..., c]
        counts = (codes >= r.low_code) & (codes <= r.high_code)
        counts &= counts.sum(axis=1, keepdims=True) >= 2
        light = np.log(np.maximum(table[codes], 1e-9)) - places.log_exposure
        mean = np.average(light, axis=1, weights=counts + 1e-12, keepdims=True)
        expected = np.exp(mean + places.log_exposure)
        parts.append([values[counts] for values in (codes, expected, table[codes], light - mean)])
    codes, expected, tables, off = (np.concatenate(values) for values in zip(*parts, strict=True))
    title = f"JPEG response, {r.kind}; held-out rms {100 * r.u_rel:.2g} %"
    return _drawn(title, ("code", codes), ("linear light z", expected), tables, off)


def of_vignette(
    samples: vignette.Samples, fit: vignette.VignettingFit, half_angle_deg: float
) -> Figure:
    """Draw the transmission over the angle from the axis; half_angle_deg: of the lens."""
    angle = "angle from the optical axis [deg]", samples.r * half_angle_deg
    value = "transmission relative to the axis", samples.value / fit.level
    title = f"vignetting at f/{samples.f_number:g}; held-out rms {100 * fit.u_rel:.2g} %"
    curve = vignetting_at(fit.coefficients, samples.r)
    return _drawn(title, angle, value, curve, fit.residual_rel, samples.places)


def of_scale(readings: list[scale.LuminanceReading], fit: scale.ScaleFit) -> Figure:
    """Draw the meter's readings, and the corrected values of the picture."""
    meter, image = np.array([(r.meter, r.image * fit.factor) for r in readings]).T
    title = f"scale: k times {fit.factor:.4f}, u {100 * fit.u_rel:.1f} %"
    places = [r.place for r in readings if r.place]
    number = "reading", np.arange(1, len(readings) + 1)
    return _drawn(title, number, ("meter [cd/m2 or lx]", meter), image, fit.residual, places)


def of_lens(targets: lens.Targets, fit: lens.LensFit) -> Figure:
    """Draw the targets' distances from the centre over their angles from the axis."""
    level = fit.lens if not targets.pose_known else level_lens(fit.lens)
    x, y, angle_rad = lens_pixels(level, targets.rays)
    at, fitted = (
        np.hypot(px - level.centre_px[0], py - level.centre_px[1])
        for px, py in ((targets.x_px, targets.y_px), (x, y))
    )
    angle = "angle from the optical axis [deg]", np.degrees(angle_rad)
    title = f"lens, {fit.lens.mapping}; held-out rms {fit.rms_px:.2g} px ({fit.rms_deg:.2g} deg)"
    return _drawn(title, angle, ("distance from the centre [px]", at), fitted, at / fitted - 1.0)


def of_circle(picture: NDArray[np.uint8], circle: Circle) -> Figure:
    """Draw the image circle over the picture [h, w]."""
    from matplotlib.figure import Figure

    (x, y), r, turn = circle.centre_px, circle.radius_px, np.linspace(0, 2 * np.pi, 400)
    axes = (figure := Figure(figsize=(4.2, 3.4), layout="constrained")).subplots()
    axes.imshow(picture, cmap="gray")
    axes.plot(x - 0.5 + r * np.cos(turn), y - 0.5 + r * np.sin(turn), color=RED, linewidth=1.2)
    title = f"centre {x:.1f}, {y:.1f}, radius {r:.1f} px, edge within {circle.u_px:.2f} px"
    axes.set_title(title, fontsize=8, color=INK)
    return figure


def of_colour(colours: colour.Colours, fit: colour.ColourFit) -> Figure:
    """Draw the readings of the patches, and the fitted luminance."""
    new = colours.rgb @ np.array(fit.y_from_rgb) * fit.scale
    title = f"colour to luminance; held-out rms {100 * fit.u_rel:.2g} %"
    number = "patch", np.arange(1, len(new) + 1)
    reading = "reading, or chart [%]", colours.y
    return _drawn(title, number, reading, new, -fit.residual, colours.places)


def of_shutter(fit: shutter.ShutterFit) -> Figure:
    """Draw the fitted times over the nominal ones, and the times that were assumed (blue)."""
    nominal, true = np.array([(t.nominal_s, t.true_s) for t in fit.times]).T
    assumed, label = np.array(fit.assumed_s), "true over nominal time"
    title = f"shutter: {len(fit.times)} times from {max(fit.brackets)} brackets"
    time, ratio = ("nominal time [s]", nominal), (label, true / nominal)
    return _drawn(title, time, ratio, assumed / nominal, true / assumed - 1.0)


def of_pixels(defects: pixels.PixelDefects) -> Figure:
    """Draw the bad pixels over a dark frame."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(4.2, 3.4), layout="constrained")).subplots()
    places = [Place(defects.frames[0], x + 0.5, y + 0.5) for x, y in defects.bad_px]
    if places:
        _over(figure, axes, places, np.zeros(len(places)))
    return figure


def of_linearity(levels: linearity.Levels, fit: linearity.LinearityFit) -> Figure:
    """Draw light divided by exposure time of each frame and block, recorded and corrected (blue).

    Values are relative to the block's mean, over the share of the full scale.
    """
    corrected = levels.share * linearity_factor(levels.share, fit.coefficients)
    logs = []
    for light, offset_s in ((levels.share, 0.0), (corrected, fit.offset_s)):
        log = np.log(light / (levels.seconds[:, None] + offset_s))
        logs.append((log - np.nanmean(log, axis=0)).ravel())
    share, good = levels.share.ravel(), np.isfinite(logs[0])
    before, after, x = np.exp(logs[0][good]), logs[1][good], 100 * share[good]
    title = f"Linearity; held-out rms {100 * fit.u_rel:.2g} %"
    label = "share of the full scale [%]"
    return _drawn(title, (label, x), ("light over time", before), np.exp(after), after)


def of_stray(readings: Sequence[stray.StrayReading], fit: stray.StrayFit) -> Figure:
    """Draw the recorded stray light of each reading, and that of the kernel."""
    recorded = np.array([r.stray_cdm2 for r in readings])
    title = f"Stray light: {100 * fit.total_share:.2g} % of a source's light is spread"
    off, places = recorded / fit.predicted_cdm2 - 1.0, [r.place for r in readings]
    number = "reading", np.arange(1, len(recorded) + 1)
    return _drawn(title, number, ("stray light [cd/m²]", recorded), fit.predicted_cdm2, off, places)
