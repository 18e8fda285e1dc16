"""Draw one picture for each fit: readings, fitted curve and residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.frames import Place
from fieldlum.calibrate.lens_circle import grey_picture
from fieldlum.core.arrays import Array
from fieldlum.core.plot_style import BLUE, GREEN, INK, RED, SAND, open_axes
from fieldlum.optics.images import read_panorama
from fieldlum.optics.photometry import linearity_factor, response_table, vignetting_at
from fieldlum.optics.photometry.stray_light import kernel_per_sr
from fieldlum.optics.projection import equirect_pixel
from fieldlum.session import replacing_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fieldlum.calibrate import (
        colour,
        lens,
        lens_circle,
        linearity,
        pixels,
        response,
        scale,
        shutter,
        stray,
        vignette,
    )


Places = Sequence[Place]
DOTS: dict[str, Any] = {"color": RED, "marker": "o", "markersize": 3.5, "linestyle": ""}
LINE: dict[str, Any] = {"color": BLUE, "linewidth": 1.2}
_TURN = np.linspace(0, 2 * np.pi, 400)


def _two(
    title: str, shares: tuple[float, float] = (3, 2), places: Places = (), off: Array | None = None
) -> tuple[Figure, Any, Any]:
    """Return a figure and its two axes; with places, a third has them over the picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.4 if places else 8.4, 3.4), layout="constrained")
    widths = (*shares, 3) if places else shares
    left, right, *more = figure.subplots(1, len(widths), width_ratios=widths)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    for axes in (left, right):
        open_axes(axes)
    if places:
        _over(figure, more[0], places, np.zeros(len(places)) if off is None else off)
    return figure, left, right


def _over(figure: Figure, axes: Any, places: Places, off: Array) -> None:
    """Draw the picture with most of the places, and on it their residuals `off` [n], a share.

    Places of other frames are drawn too, because all frames show one sensor; those of other
    panoramas are not.
    """
    files = Counter(place.path for place in places)
    path = files.most_common(1)[0][0]
    is_panorama = path.suffix.lower() in (".exr", ".hdr")
    shown = np.array([place.path == path or not is_panorama for place in places])
    at = np.array([(place.x, place.y) for place in places], float)[shown]
    percent = 100 * np.asarray(off)[shown]
    if is_panorama:
        panorama = read_panorama(path)
        light = np.nan_to_num(panorama.luminance_cdm2)
        grey = np.log(np.maximum(light, 1e-3 * float(np.percentile(light, 99))))
        size = len(grey), grey.shape[1]
        row, column = equirect_pixel(at[:, 1], at[:, 0], *size, panorama.heading_deg)
        at = np.stack([column, row], axis=1)
    else:
        grey = grey_picture(path)
    height, width = grey.shape
    step = max(height // 800, 1)  # the figure has fewer pixels
    axes.imshow(grey[::step, ::step], cmap="gray", extent=(0, width, height, 0))
    limit = max(float(np.abs(percent).max()), 0.1)
    marks = axes.scatter(*at.T, s=26, c=percent, cmap="coolwarm", vmin=-limit, vmax=limit)
    marks.set(edgecolors="white", linewidths=0.6)
    more = f" and {len(files) - 1} more" if len(files) > 1 and not is_panorama else ""
    axes.set_title(path.name + more, fontsize=8, color=INK)
    axes.set_axis_off()
    if percent.any():
        figure.colorbar(marks, ax=axes, shrink=0.8, label="off [%]")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, SVG or PDF, by suffix; the file appears complete or not at all."""
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _equal_line(axes: Any, x: Array, y: Array) -> None:
    """Draw the line of equal values through logarithmic axes, with labels 1, 2, 5, 10 and so on."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    ends = [min(x.min(), y.min()) * 0.8, max(x.max(), y.max()) * 1.25]
    axes.loglog(ends, ends, **LINE)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_formatter(NullFormatter())


def _percent(axes: Any, x: Array, residual: Array, label: str) -> None:
    axes.axhline(0, **LINE)
    axes.plot(x, 100 * residual, **DOTS)
    axes.set(xlabel=label, ylabel="reading less fit [%]")


def of_response(places: response.Places, fit: response.ResponseFit) -> Figure:
    """Draw the response tables, and the residuals of the sampled places over the code.

    A residual is the light of a place by one frame less the mean by all frames [%].
    """
    r = fit.response
    figure, left, right = _two(f"JPEG response, {r.kind}; held-out rms {100 * r.u_rel:.2g} %")
    for c, (curve, name) in enumerate(
        zip((r.red, r.green, r.blue), (RED, GREEN, BLUE), strict=True)
    ):
        table, codes = response_table(r.kind, curve), places.codes[..., c]
        left.plot(np.arange(1, 256), np.maximum(table[1:], 1e-5), color=name, linewidth=1.3)
        counts = (codes >= r.low_code) & (codes <= r.high_code)
        counts &= counts.sum(axis=1, keepdims=True) >= 2
        light = np.log(np.maximum(table[codes], 1e-9)) - places.log_exposure
        mean = np.average(light, axis=1, weights=counts + 1e-12, keepdims=True)
        right.plot(codes[counts], 100 * (light - mean)[counts], ",", color=name, alpha=0.5)
    left.axvspan(r.low_code, r.high_code, color=SAND, alpha=0.5, linewidth=0)
    left.set(xlabel="code", ylabel="linear light z", yscale="log", xlim=(0, 255), ylim=(1e-4, 1.3))
    right.set(xlabel="code", ylabel="place's light less its mean [%]", ylim=(-15, 15))
    return figure


def of_vignette(
    samples: vignette.Samples, fit: vignette.VignettingFit, half_angle_deg: float
) -> Figure:
    """Draw readings and fit of the transmission over the angle from the axis, and the residuals.

    half_angle_deg : half of the lens's full angle. Residuals are reading less fit [%].
    """
    title = f"vignetting at f/{samples.f_number:g}; held-out rms {100 * fit.u_rel:.2g} %"
    figure, left, right = _two(title, places=samples.places, off=fit.residual_rel)
    r = np.linspace(0, 1, 200)
    left.plot(samples.r * half_angle_deg, samples.value / fit.level, label="readings", **DOTS)
    left.plot(r * half_angle_deg, vignetting_at(fit.coefficients, r), label="fit", **LINE)
    left.set(xlabel="angle from the optical axis [deg]", ylim=(0, 1.1))
    left.set(ylabel="transmission relative to the axis")
    left.legend(frameon=False, fontsize=8)
    _percent(right, samples.r * half_angle_deg, fit.residual_rel, "angle [deg]")
    return figure


def of_scale(readings: list[scale.LuminanceReading], fit: scale.ScaleFit) -> Figure:
    """Draw the pictures' values, corrected by the fit, over the meter's readings, and residuals.

    A residual is the meter's reading less the corrected value of the picture [%].
    """
    title = f"scale: k times {fit.factor:.4f}, u {100 * fit.u_rel:.1f} %"
    places = [r.place for r in readings if r.place]
    figure, left, right = _two(title, places=places, off=fit.residual if places else None)
    meter, image = np.array([(r.meter, r.image * fit.factor) for r in readings]).T
    for kind, unit, marker in (("spot", "cd/m2", "o"), ("illuminance", "lx", "s")):
        rows = np.array([r.kind == kind for r in readings])
        if rows.any():
            style = {**DOTS, "marker": marker, "label": f"{kind} [{unit}]"}
            left.plot(meter[rows], image[rows], **style)
    _equal_line(left, meter, image)
    left.set(xlabel="meter", ylabel="picture, corrected")
    left.legend(frameon=False, fontsize=8)
    _percent(right, np.arange(1, len(readings) + 1), fit.residual, "reading")
    return figure


def of_lens(targets: lens.Targets, fit: lens.LensFit) -> Figure:
    """Draw the targets in the image circle, and their distances from the fitted places."""
    figure, left, right = _two(
        f"lens, {fit.lens.mapping}; held-out rms {fit.rms_px:.2g} px ({fit.rms_deg:.2g} deg)"
    )
    (x, y), r = fit.lens.centre_px, fit.lens.radius_px
    left.plot(x + r * np.cos(_TURN), y + r * np.sin(_TURN), **LINE)
    left.plot([x], [y], "+", color=BLUE)
    left.scatter(targets.x_px, targets.y_px, s=10, color=RED, linewidths=0)
    left.set(xlabel="x [px]", ylabel="y [px]", aspect="equal")
    left.invert_yaxis()
    right.plot(np.hypot(targets.x_px - x, targets.y_px - y) / r, fit.residual_px, **DOTS)
    right.set(xlabel="distance from the centre / radius", ylabel="miss [px]", ylim=(0, None))
    return figure


def of_circle(picture: NDArray[np.uint8], image_circle: lens_circle.Circle) -> Figure:
    """Draw the image circle over the picture [h, w]."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(picture, cmap="gray")
    (x, y), r = image_circle.centre_px, image_circle.radius_px
    axes.plot(x - 0.5 + r * np.cos(_TURN), y - 0.5 + r * np.sin(_TURN), color=RED, linewidth=1.2)
    axes.plot([x - 0.5], [y - 0.5], "+", color=RED)
    title = f"centre {x:.1f}, {y:.1f}, radius {r:.1f} px, edge within {image_circle.u_px:.2f} px"
    axes.set_title(title, fontsize=9, loc="left")
    return figure


def of_colour(colours: colour.Colours, fit: colour.ColourFit) -> Figure:
    """Draw the fitted luminance (y) against the readings (x), and the residuals [%] by patch."""
    title = f"colour to luminance; held-out rms {100 * fit.u_rel:.2g} %"
    figure, left, right = _two(title, places=colours.places, off=-fit.residual)
    new = colours.rgb @ np.array(fit.y_from_rgb) * fit.scale
    shown = np.clip(colours.rgb / colours.rgb.max(axis=1, keepdims=True), 0, 1) ** (1 / 2.2)
    left.scatter(colours.y, new, s=60, c=shown, edgecolors=INK, linewidths=0.5)
    _equal_line(left, colours.y, new)
    left.set(xlabel="reading, or chart [%]", ylabel="picture, at the readings' scale")
    _percent(right, np.arange(1, len(new) + 1), -fit.residual, "patch")
    return figure


def of_shutter(fit: shutter.ShutterFit) -> Figure:
    """Draw how much the fitted times differ from the nominal and from the assumed times [%].

    Positive where the true time is longer. The bars are two standard uncertainties long each way.
    """
    title = f"shutter: {len(fit.times)} times from {max(fit.brackets)} brackets"
    figure, left, right = _two(title, (1, 1))
    nominal, true, u = np.array([(t.nominal_s, t.true_s, t.u_rel) for t in fit.times]).T
    for axes, against, label in (
        (left, nominal, "true over nominal [%]"),
        (right, np.array(fit.assumed_s), "over assumed [%]"),
    ):
        axes.axhline(0, **LINE)
        axes.errorbar(nominal, 100 * (true / against - 1), 200 * u, **DOTS)
        axes.set(xscale="log", xlabel="nominal time [s]", ylabel=label)
    return figure


def of_pixels(defects: pixels.PixelDefects, width_px: int, height_px: int) -> Figure:
    """Draw the bad pixels on the sensor, and a histogram of their distance from its middle."""
    title = f"bad pixels: {len(defects.bad_px)}, the same in {defects.views} views"
    places = [Place(defects.frames[0], x + 0.5, y + 0.5) for x, y in defects.bad_px]
    figure, left, right = _two(title, (2, 1), places)
    x, y = np.array(defects.bad_px, float).reshape(-1, 2).T
    left.plot(x, y, **DOTS)
    left.set(xlim=(0, width_px), ylim=(height_px, 0), aspect="equal", xlabel="column", ylabel="row")
    right.hist(np.hypot(x - width_px / 2, y - height_px / 2), bins=12, color=BLUE)
    right.set(xlabel="from the middle [px]", ylabel="pixels")
    return figure


def of_linearity(levels: linearity.Levels, fit: linearity.LinearityFit) -> Figure:
    """Draw light divided by exposure time of each frame and block, before and after the correction.

    Values are relative to the block's mean [%], over the share of the full scale.
    """
    figure, left, right = _two(f"Linearity; held-out rms {100 * fit.u_rel:.2g} %")
    corrected = levels.share * linearity_factor(levels.share, fit.coefficients)
    for axes, light, offset_s, title in (
        (left, levels.share, 0.0, "as recorded"),
        (right, corrected, fit.offset_s, "corrected"),
    ):
        off = np.log(light / (levels.seconds[:, None] + offset_s))
        off -= np.nanmean(off, axis=0)
        axes.plot(100 * levels.share.ravel(), 100 * off.ravel(), ",", color=GREEN)
        axes.set(xlabel="share of the full scale [%]", ylim=(-2, 2), title=title)
    left.set(ylabel="light over time less its mean [%]")
    return figure


def of_stray(readings: Sequence[stray.StrayReading], fit: stray.StrayFit) -> Figure:
    """Draw the kernel over the angle, and the predicted over the recorded stray light."""
    recorded = np.array([r.stray_cdm2 for r in readings])
    places = [r.place for r in readings if r.place]
    off = fit.predicted_cdm2 / recorded - 1.0 if places else None
    title = f"Stray light: {100 * fit.total_share:.2g} % of a source's light is spread"
    figure, left, right = _two(title, places=places, off=off)
    angle = np.geomspace(0.5, 180.0, 300)
    nodes, values = np.asarray(fit.kernel.angle_deg), np.asarray(fit.kernel.per_sr)
    left.plot(angle, 100 * kernel_per_sr(np.radians(angle), nodes, values), **LINE)
    left.plot(nodes, 100 * values, **DOTS)
    left.set(xlabel="angle from the source [deg]", ylabel="K [% per sr]", xscale="log")
    right.plot(recorded, fit.predicted_cdm2, **DOTS)
    _equal_line(right, recorded, fit.predicted_cdm2)
    right.set(xlabel="recorded [cd/m²]", ylabel="by the kernel [cd/m²]")
    return figure
