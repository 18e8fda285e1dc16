"""Draw one picture for each fit: readings, fitted curve and residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.calibrate.lens import Circle, grey_picture
from fieldlum.calibrate.readings import Place
from fieldlum.core.arrays import Array
from fieldlum.core.plot_style import BLUE, GREEN, INK, RED, open_axes
from fieldlum.optics.images import read_panorama
from fieldlum.optics.photometry import linearity_factor, response_table, vignetting_at
from fieldlum.optics.projection import equirect_pixel
from fieldlum.optics.stray_light import kernel_per_sr
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

DOTS: dict[str, Any] = {"color": RED, "marker": "o", "markersize": 3.5, "linestyle": ""}
LINE: dict[str, Any] = {"color": BLUE, "linewidth": 1.2}
_TURN = np.linspace(0, 2 * np.pi, 400)


class Panel(NamedTuple):
    """Axes of a picture: x, y and style of each series, settings of the axes, and a background."""

    series: Sequence[tuple[ArrayLike, ArrayLike, dict[str, Any]]]
    settings: dict[str, Any]
    background: Array | None = None


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, SVG or PDF, by suffix; the file appears complete or not at all."""
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _drawn(
    title: str, *panels: Panel, places: Sequence[Place] = (), off: Array | None = None
) -> Figure:
    """Return a figure of panels; with places, a further panel has them over the picture."""
    from matplotlib.figure import Figure

    count = len(panels) + bool(places)
    figure = Figure(figsize=(4.2 * count, 3.4), layout="constrained")
    all_axes = figure.subplots(1, count, squeeze=False)[0]
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK)
    for axes, panel in zip(all_axes, panels, strict=False):
        if panel.background is not None:
            axes.imshow(panel.background, cmap="gray")
        for x, y, style in panel.series:
            axes.plot(x, y, **style)
        axes.set(**panel.settings)
        open_axes(axes)
        if any("label" in style for *_, style in panel.series):
            axes.legend(frameon=False, fontsize=8)
    if places:
        _over(figure, all_axes[-1], places, np.zeros(len(places)) if off is None else off)
    return figure


def _over(figure: Figure, axes: Any, places: Sequence[Place], off: Array) -> None:
    """Draw the picture with most of the places, and on it their residuals `off` [n], a share.

    Places of other frames are drawn too, because all frames show one sensor; those of other
    panoramas are not.
    """
    path, count = Counter(place.path for place in places).most_common(1)[0]
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
    style = {"edgecolors": "white", "linewidths": 0.6, "cmap": "coolwarm"}
    marks = axes.scatter(*at.T, s=26, c=percent, vmin=-limit, vmax=limit, **style)
    others = "" if shown.sum() == count else " and other frames"
    axes.set_title(path.name + others, fontsize=8, color=INK)
    axes.set_axis_off()
    if percent.any():
        figure.colorbar(marks, ax=axes, shrink=0.8, label="off [%]")


def _residual(x: Array, share: Array, label: str) -> Panel:
    zero = (x[[x.argmin(), x.argmax()]], (0, 0), LINE)
    settings = {"xlabel": label, "ylabel": "reading less fit [%]"}
    return Panel([zero, (x, 100 * share, DOTS)], settings)


def _equal(x: Array, y: Array, xlabel: str, ylabel: str) -> Panel:
    """Return y over x in logarithmic axes, with the line of equal values."""
    ends = [min(x.min(), y.min()) * 0.8, max(x.max(), y.max()) * 1.25]
    settings = {"xscale": "log", "yscale": "log", "xlabel": xlabel, "ylabel": ylabel}
    return Panel([(ends, ends, LINE), (x, y, DOTS)], settings)


def of_response(places: response.Places, fit: response.ResponseFit) -> Figure:
    """Draw the response tables, and the residuals of the sampled places over the code.

    A residual is the light of a place by one frame less the mean by all frames [%].
    """
    r, tables, residuals = fit.response, [], []
    curves = zip((r.red, r.green, r.blue), (RED, GREEN, BLUE), strict=True)
    for c, (curve, name) in enumerate(curves):
        table, codes = response_table(r.kind, curve), places.codes[..., c]
        tables.append((np.arange(1, 256), np.maximum(table[1:], 1e-5), {"color": name}))
        counts = (codes >= r.low_code) & (codes <= r.high_code)
        counts &= counts.sum(axis=1, keepdims=True) >= 2
        light = np.log(np.maximum(table[codes], 1e-9)) - places.log_exposure
        mean = np.average(light, axis=1, weights=counts + 1e-12, keepdims=True)
        style = {"color": name, "alpha": 0.5, "marker": ",", "linestyle": ""}
        residuals.append((codes[counts], 100 * (light - mean)[counts], style))
    left = {"xlabel": "code", "ylabel": "linear light z", "yscale": "log", "ylim": (1e-4, 1.3)}
    right = {"xlabel": "code", "ylabel": "place's light less its mean [%]", "ylim": (-15, 15)}
    title = f"JPEG response, {r.kind}; held-out rms {100 * r.u_rel:.2g} %"
    return _drawn(title, Panel(tables, left), Panel(residuals, right))


def of_vignette(
    samples: vignette.Samples, fit: vignette.VignettingFit, half_angle_deg: float
) -> Figure:
    """Draw readings and fit of the transmission over the angle from the axis, and the residuals.

    half_angle_deg : half of the lens's full angle. Residuals are reading less fit [%].
    """
    r, angle = np.linspace(0, 1, 200), samples.r * half_angle_deg
    curve = (r * half_angle_deg, vignetting_at(fit.coefficients, r), {**LINE, "label": "fit"})
    dots = (angle, samples.value / fit.level, {**DOTS, "label": "readings"})
    settings = {"xlabel": "angle from the optical axis [deg]", "ylim": (0, 1.1)}
    settings["ylabel"] = "transmission relative to the axis"
    title = f"vignetting at f/{samples.f_number:g}; held-out rms {100 * fit.u_rel:.2g} %"
    panels = Panel([dots, curve], settings), _residual(angle, fit.residual_rel, "angle [deg]")
    return _drawn(title, *panels, places=samples.places, off=fit.residual_rel)


def of_scale(readings: list[scale.LuminanceReading], fit: scale.ScaleFit) -> Figure:
    """Draw the pictures' values, corrected by the fit, over the meter's readings, and residuals.

    A residual is the meter's reading less the corrected value of the picture [%].
    """
    meter, image = np.array([(r.meter, r.image * fit.factor) for r in readings]).T
    panels = (
        _equal(meter, image, "meter [cd/m2 or lx]", "picture, corrected"),
        _residual(np.arange(1, len(readings) + 1), fit.residual, "reading"),
    )
    title = f"scale: k times {fit.factor:.4f}, u {100 * fit.u_rel:.1f} %"
    places = [r.place for r in readings if r.place]
    return _drawn(title, *panels, places=places, off=fit.residual)


def of_lens(targets: lens.Targets, fit: lens.LensFit) -> Figure:
    """Draw the targets in the image circle, and their distances from the fitted places."""
    (x, y), r = fit.lens.centre_px, fit.lens.radius_px
    circle = (x + r * np.cos(_TURN), y + r * np.sin(_TURN), LINE)
    settings = {"xlabel": "x [px]", "ylabel": "y [px]", "aspect": "equal"}
    limits = {"ylim": (y + 1.05 * r, y - 1.05 * r)}
    distance = np.hypot(targets.x_px - x, targets.y_px - y) / r
    off = {"xlabel": "distance from the centre / radius", "ylabel": "miss [px]"}
    return _drawn(
        f"lens, {fit.lens.mapping}; held-out rms {fit.rms_px:.2g} px ({fit.rms_deg:.2g} deg)",
        Panel([circle, (targets.x_px, targets.y_px, DOTS)], settings | limits),
        Panel([(distance, fit.residual_px, DOTS)], off),
    )


def of_circle(picture: NDArray[np.uint8], circle: Circle) -> Figure:
    """Draw the image circle over the picture [h, w]."""
    (x, y), r = circle.centre_px, circle.radius_px
    line = (x - 0.5 + r * np.cos(_TURN), y - 0.5 + r * np.sin(_TURN), {**LINE, "color": RED})
    title = f"centre {x:.1f}, {y:.1f}, radius {r:.1f} px, edge within {circle.u_px:.2f} px"
    return _drawn(title, Panel([line], {"xlabel": "x [px]"}, picture))


def of_colour(colours: colour.Colours, fit: colour.ColourFit) -> Figure:
    """Draw the fitted luminance (y) against the readings (x), and the residuals [%] by patch."""
    new = colours.rgb @ np.array(fit.y_from_rgb) * fit.scale
    panels = (
        _equal(colours.y, new, "reading, or chart [%]", "picture, at the readings' scale"),
        _residual(np.arange(1, len(new) + 1), -fit.residual, "patch"),
    )
    title = f"colour to luminance; held-out rms {100 * fit.u_rel:.2g} %"
    return _drawn(title, *panels, places=colours.places, off=-fit.residual)


def of_shutter(fit: shutter.ShutterFit) -> Figure:
    """Draw how much the fitted times differ from the nominal and from the assumed times [%].

    Positive where the true time is longer. The bars are two standard uncertainties long each way.
    """
    nominal, true, u = np.array([(t.nominal_s, t.true_s, t.u_rel) for t in fit.times]).T
    panels = []
    for against, label in ((nominal, "nominal"), (np.array(fit.assumed_s), "assumed")):
        off = 100 * (true / against - 1)
        bars = ([nominal, nominal], [off - 200 * u, off + 200 * u], LINE)
        settings = {"xscale": "log", "xlabel": "nominal time [s]"}
        settings["ylabel"] = f"true over {label} [%]"
        panels.append(Panel([bars, (nominal, off, DOTS)], settings))
    return _drawn(f"shutter: {len(fit.times)} times from {max(fit.brackets)} brackets", *panels)


def of_pixels(defects: pixels.PixelDefects) -> Figure:
    """Draw the bad pixels over a dark frame."""
    places = [Place(defects.frames[0], x + 0.5, y + 0.5) for x, y in defects.bad_px]
    title = f"bad pixels: {len(places)} in {len(defects.frames)} dark frames"
    return _drawn(title, places=places) if places else _drawn(title, Panel([], {}))


def of_linearity(levels: linearity.Levels, fit: linearity.LinearityFit) -> Figure:
    """Draw light divided by exposure time of each frame and block, before and after the correction.

    Values are relative to the block's mean [%], over the share of the full scale.
    """
    corrected = levels.share * linearity_factor(levels.share, fit.coefficients)
    panels, style = [], {"color": GREEN, "marker": ",", "linestyle": ""}
    cases = (levels.share, 0.0, "as recorded"), (corrected, fit.offset_s, "corrected")
    for light, offset_s, title in cases:
        off = np.log(light / (levels.seconds[:, None] + offset_s))
        off -= np.nanmean(off, axis=0)
        settings = {"xlabel": "share of the full scale [%]", "ylim": (-2, 2), "title": title}
        settings["ylabel"] = "light over time less its mean [%]"
        panels.append(Panel([(100 * levels.share.ravel(), 100 * off.ravel(), style)], settings))
    return _drawn(f"Linearity; held-out rms {100 * fit.u_rel:.2g} %", *panels)


def of_stray(readings: Sequence[stray.StrayReading], fit: stray.StrayFit) -> Figure:
    """Draw the kernel over the angle, and the predicted over the recorded stray light."""
    recorded, angle = np.array([r.stray_cdm2 for r in readings]), np.geomspace(0.5, 180.0, 300)
    nodes, values = np.asarray(fit.kernel.angle_deg), np.asarray(fit.kernel.per_sr)
    curve = 100 * kernel_per_sr(np.radians(angle), nodes, values)
    settings = {"xlabel": "angle from the source [deg]", "ylabel": "K [% per sr]", "xscale": "log"}
    panels = (
        Panel([(angle, curve, LINE), (nodes, 100 * values, DOTS)], settings),
        _equal(recorded, fit.predicted_cdm2, "recorded [cd/m²]", "by the kernel [cd/m²]"),
    )
    title = f"Stray light: {100 * fit.total_share:.2g} % of a source's light is spread"
    off, places = fit.predicted_cdm2 / recorded - 1.0, [r.place for r in readings]
    return _drawn(title, *panels, places=places, off=off)
