"""Draw a fit: readings, fitted values and residuals, and the residuals over a picture."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Array, UInts8
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.files import read_bytes
from fieldlum.core.plot_style import BLUE, INK, RED, new_figure, open_axes
from fieldlum.optics.images import read_panorama
from fieldlum.optics.projection import equirect_pixel
from fieldlum.optics.raw import MAX_CAMERA_PIXELS, jpeg_size, read_mosaic
from fieldlum.session import replacing_path


class Place(NamedTuple):
    """Where a reading was taken, in the picture `path`.

    x, y: of a frame the place on the sensor [px], x right, y down; of a panorama azimuth, clockwise
    from north, and altitude [deg].
    """

    path: Path
    x: float
    y: float


class Chart(NamedTuple):
    """The content of a figure of a fit to n readings: curves, residuals, and places on a picture.

    residual_rel [n]: reading / fit - 1, to first order; places [n]: where the readings were taken,
    empty if unknown; x, y: label and values [n] of the axes, y those of the readings; fitted [n]: y
    by the fit. Without x the readings are numbered; without y only the places are drawn.
    """

    title: str
    residual_rel: Array
    places: Sequence[Place] = ()
    x: tuple[str, Array] = ("", np.empty(0))
    y: tuple[str, Array] = ("", np.empty(0))
    fitted: Array | Sequence[float] = ()


def draw(chart: Chart, path: Path) -> None:
    """Write a chart as PNG, SVG or PDF, by suffix; the file appears complete or not at all.

    Raises InputError if the picture of its places cannot be read, ValueError for another suffix.
    """
    has_curves, has_places = bool(chart.y[0]), len(chart.places) > 0
    columns = max(2 * has_curves + has_places, 1)
    figure = new_figure(4.2 * columns, 3.4)
    axes = figure.subplots(1, columns, squeeze=False)[0]
    figure.suptitle(chart.title, x=0.01, ha="left", fontsize=10, color=INK)
    if has_curves:
        _draw_curves(chart, *axes[:2])
    if has_places:
        _draw_places(chart, axes[-1])
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_curves(chart: Chart, left: Any, right: Any) -> None:
    """Draw readings (red) and fit (blue) on the axes `left`, and the residuals on `right`."""
    y_label, y = chart.y
    label, x = chart.x if chart.x[0] else ("reading", np.arange(1, len(y) + 1))
    shown = {"linestyle": "", "markersize": 3.5, "alpha": min(1.0, 200 / max(len(x), 1))}
    left.plot(x, y, "o", color=RED, **shown)
    left.plot(x, chart.fitted, ".", color=BLUE, **shown)
    wide = y.min() > 0 and y.max() > 30 * y.min()
    left.set(yscale="log" if wide else "linear", xlabel=label, ylabel=y_label)
    right.plot(x, 100 * chart.residual_rel, "o", color=RED, **shown)
    right.axhline(0.0, color=BLUE, linewidth=1.2)
    right.set(xlabel=label, ylabel="reading less fit [%]")
    for axes in (left, right):
        open_axes(axes)


def _draw_places(chart: Chart, axes: Any) -> None:
    """Draw the picture with most of the places, and on it their residuals.

    Places of other frames are drawn too, because all frames show one sensor; those of other
    panoramas are not.
    """
    path = Counter(place.path for place in chart.places).most_common(1)[0][0]
    is_panorama = path.suffix.lower() in (".exr", ".hdr")
    shown = np.array([place.path == path or not is_panorama for place in chart.places])
    # x, y [k, 2] in pixels of the frame; of a panorama first azimuth and altitude in degrees
    at = np.array([place[1:] for place in chart.places], float)[shown]
    percent = 100 * np.asarray(chart.residual_rel)[shown]
    if is_panorama:
        panorama = read_panorama(path)
        light = np.nan_to_num(panorama.luminance_cdm2)
        grey = np.log(np.maximum(light, 1e-3 * float(np.percentile(light, 99))))
        height, width = grey.shape
        row, column = equirect_pixel(at[:, 1], at[:, 0], height, width, panorama.heading_deg)
        at = np.stack([column, row], axis=1)
    else:
        grey = grey_picture(path)
    height, width = grey.shape
    step = max(height // 800, 1)  # the figure has fewer pixels
    axes.imshow(grey[::step, ::step], cmap="gray", extent=(0, width, height, 0))
    limit = max(float(np.abs(percent).max()), 0.1)
    few = len(at) < 100  # many marks with white edges would hide the picture
    style = {"s": 26 if few else 4, "edgecolors": "white", "linewidths": 0.6 * few}
    marks = axes.scatter(*at.T, c=percent, vmin=-limit, vmax=limit, cmap="coolwarm", **style)
    axes.set_title(path.name, fontsize=8, color=INK)
    axes.set_axis_off()
    if percent.any():
        axes.figure.colorbar(marks, ax=axes, shrink=0.8, label="off [%]")


def grey_picture(path: Path) -> UInts8:
    """Read a raw, JPEG, PNG or TIFF file as grey codes 0 to 255 at sensor size, [h, w].

    A raw frame is stretched to its own brightness, so that its codes have no absolute meaning.
    Raises InputError for a file that cannot be read, or has over 500 million pixels.
    """
    import cv2

    if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff"):
        with input_errors(path, "JPEG, PNG or raw", "check the path", OSError):
            data = read_bytes(path)
        stated = (int.from_bytes(data[16:20]), int.from_bytes(data[20:24]))  # of a PNG, in its IHDR
        width, height = stated if data.startswith(b"\x89PNG") else jpeg_size(path)
        if width * height > MAX_CAMERA_PIXELS:
            expected = f"at most {MAX_CAMERA_PIXELS:,} pixels"
            raise InputError(path, f"{width} x {height} pixels", expected, "reduce the picture")
        how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), how) if data else None
        if picture is None:
            remedy = "convert it to JPEG or PNG, or copy it from the card again"
            raise InputError(path, "no picture that OpenCV reads", "JPEG, PNG or raw", remedy)
        return np.asarray(picture, np.uint8)
    counts = read_mosaic(path, lens_f_number=1.0).counts.astype(np.float32)
    cell = cv2.GaussianBlur(counts, (3, 3), 0)  # half green, a quarter red and blue at each pixel
    low, high = np.percentile(cell, [1, 99.5])
    return (255 * np.clip((cell - low) / max(high - low, 1e-6), 0, 1) ** (1 / 2.2)).astype(np.uint8)
