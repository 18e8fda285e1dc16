"""The report's pictures: pure functions from arrays to SVG text or PNG bytes, without pyplot."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from fieldlum.core.arrays import Floats
from fieldlum.core.false_colour import COLOUR_MAP, RANGE_CDM2, coloured
from fieldlum.core.plot_style import BLUE, GREEN, INK, PALE, RED, styled
from fieldlum.optics.projection import compass_name

CLASS_LIMITS = ((0.35, "high"), (0.40, "medium"), (0.45, "minimum"))  # EN 17037:2018, table A.7
POLAR_RANGE = (0.15, 0.6)  # of DGP; points above it are drawn at the rim; chosen
CAPTURED, PREDICTED = RED, BLUE
CLASS_COLOURS = {"high": GREEN, "medium": "#7fae2e", "minimum": "#e0a100", "none": "#c0392b"}


def _svg(figure: Figure) -> str:
    """Return inline SVG without the XML prologue."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _png(figure: Figure, dpi: int = 110) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, bbox_inches="tight")
    return buffer.getvalue()


# ----------------------------------------------------------------------------------------------
# luminance pictures


def luminance_scale_svg() -> str:
    """Return the colour bar of the false-colour pictures, 1 to 10 000 cd/m2, as SVG text."""
    with styled():
        figure = Figure(figsize=(5.0, 0.28))
        axes = figure.add_axes((0, 0, 1, 1))
        ramp = np.geomspace(*RANGE_CDM2, 128)[None, :]
        axes.pcolormesh(
            np.geomspace(*RANGE_CDM2, 129),
            [0, 1],
            ramp,
            norm=LogNorm(*RANGE_CDM2),
            cmap=COLOUR_MAP,
            rasterized=True,
        )
        axes.set(xscale="log", yticks=[], xlabel="luminance, cd/m²")
        axes.set_xticks([1, 10, 100, 1000, 10000], ["1", "10", "100", "1 000", "10 000"])
        return _svg(figure)


def comparison_png(measured: Floats, predicted: Floats, labels: Sequence[str]) -> bytes:
    """Return a PNG with a row for each of n maps: measured, predicted, and their ratio.

    measured, predicted: [n, H, W] cd/m2; labels: [n]. The ratio is predicted over measured, red
    above 1, on a logarithmic scale from 1/2 to 2; values below 1 cd/m2 count as 1. As Liu, Colburn
    and Inanici 2020, Figures 9 and 23.
    """
    n = len(measured)
    with styled():
        figure = Figure(figsize=(12.0, 2.0 * n + 0.9))
        grid = figure.add_gridspec(
            n + 1, 3, height_ratios=[*[1.0] * n, 0.07], hspace=0.12, wspace=0.09
        )
        norm, spread = LogNorm(*RANGE_CDM2), Normalize(-np.log10(2.0), np.log10(2.0))
        shown = error = None
        for i in range(n):
            row = [figure.add_subplot(grid[i, k]) for k in range(3)]
            difference = np.log10(np.maximum(predicted[i], 1.0)) - np.log10(
                np.maximum(measured[i], 1.0)
            )
            shown = row[0].imshow(np.clip(measured[i], *RANGE_CDM2), norm=norm, cmap=COLOUR_MAP)
            row[1].imshow(np.clip(predicted[i], *RANGE_CDM2), norm=norm, cmap=COLOUR_MAP)
            error = row[2].imshow(difference, norm=spread, cmap="RdBu_r")
            row[0].set_ylabel(labels[i], fontsize=8)
            for axes, title in zip(
                row, ("measured", "predicted", "predicted over measured"), strict=True
            ):
                axes.set(xticks=[], yticks=[])
                if i == 0:
                    axes.set_title(title, fontsize=10)
        if shown is not None and error is not None:
            below = figure.add_subplot(grid[n, :2])
            figure.colorbar(shown, cax=below, orientation="horizontal", label="cd/m²")
            bar = figure.colorbar(
                error, cax=figure.add_subplot(grid[n, 2]), orientation="horizontal"
            )
            bar.set_ticks(
                [np.log10(f) for f in (0.5, 0.8, 1.0, 1.25, 2.0)],
                labels=["÷2", "÷1.25", "1", "×1.25", "×2"],
            )
        return _png(figure)


def fisheyes_png(views: Floats, azimuths_deg: Floats, dgp: Floats) -> bytes:
    """Return a PNG of labelled fisheye views in several directions at one hour.

    views: [d, N, N] cd/m2, NaN outside the circle; azimuths_deg, dgp: for the labels, [d].
    """
    n = len(views)
    columns = min(n, 5)
    with styled():
        figure = Figure(figsize=(2.3 * columns, 2.55 * -(-n // columns)), layout="constrained")
        cells = figure.subplots(-(-n // columns), columns, squeeze=False).ravel()
        for axes in cells:
            axes.axis("off")
        for axes, view, azimuth, value in zip(cells, views, azimuths_deg, dgp, strict=False):
            axes.imshow(coloured(view, unseen_rgb=(255, 255, 255)))
            axes.set_title(f"{compass_name(azimuth)} {azimuth:.0f}°  DGP {value:.2f}", fontsize=9)
        return _png(figure)


def strip_png(maps: Floats, labels: Sequence[str]) -> bytes:
    """Return the panoramas of a day as PNG, up to four in a row. maps: [n, H, W] cd/m2."""
    n = len(maps)
    columns = min(4, n)
    with styled():
        figure = Figure(figsize=(3.1 * columns, 1.8 * -(-n // columns)), layout="constrained")
        cells = figure.subplots(-(-n // columns), columns, squeeze=False).ravel()
        for axes in cells:
            axes.axis("off")
        for axes, image, label in zip(cells, maps, labels, strict=False):
            axes.imshow(coloured(image))
            axes.set_title(label, fontsize=9)
        return _png(figure, 90)


# ----------------------------------------------------------------------------------------------
# the light domain


def sun_path_svg(
    year_azimuth_deg: Floats,
    year_altitude_deg: Floats,
    captured_azimuth_deg: Floats,
    captured_altitude_deg: Floats,
) -> str:
    """Plot altitude over azimuth [deg] of the sun: hours of a year [n], and captures [k].

    Return SVG text.
    """
    return _captured_svg(
        (year_azimuth_deg, year_altitude_deg),
        (captured_azimuth_deg, captured_altitude_deg),
        "hours of the year",
        xlabel="sun azimuth, ° from north",
        ylabel="sun altitude, °",
        ylim=(0, None),
    )


def sky_domain_svg(
    year_dni: Floats, year_dhi: Floats, captured_dni: Floats, captured_dhi: Floats
) -> str:
    """Plot diffuse against direct irradiance [W/m2]: the weather file's hours and the captures.

    The year's: [n], empty without a weather file; the captured: [k]. Return SVG text.
    """
    return _captured_svg(
        (year_dni, year_dhi),
        (captured_dni, captured_dhi),
        "weather file",
        xlabel="direct normal irradiance, W/m²",
        ylabel="diffuse horizontal irradiance, W/m²",
    )


def _captured_svg(
    year: tuple[Floats, Floats], captured: tuple[Floats, Floats], label: str, **axes_settings: Any
) -> str:
    """Plot the captures over the hours of a year, x and y [n] of each."""
    with styled():
        figure = Figure(figsize=(5.2, 3.4))
        axes = figure.add_subplot()
        if len(year[0]):
            axes.scatter(*year, s=3, c=PALE, lw=0, label=label, rasterized=True)
        axes.scatter(*captured, s=12, c=CAPTURED, lw=0, label="captured")
        axes.set(**axes_settings)
        axes.legend(loc="upper left", bbox_to_anchor=(0, 1.14), ncols=2)
        return _svg(figure)


# ----------------------------------------------------------------------------------------------
# glare


def polar_svg(
    azimuths_deg: Floats, dgp_exceeded: Floats, low: Floats | None, high: Floats | None
) -> str:
    """Plot the DGP exceeded in 5 % of the occupied hours by view direction, over the class limits.

    All arrays: [d]. Directions run clockwise from north; low and high bound the 95 % interval. A
    NaN is a direction that was not seen: the line has a gap there. Return SVG text.
    """
    order = np.argsort(azimuths_deg)
    around = np.append(order, order[0])
    angle = np.radians(np.append(azimuths_deg[order], azimuths_deg[order[0]] + 360.0))
    with styled():
        figure = Figure(figsize=(4.6, 4.6))
        axes = figure.add_subplot(projection="polar")
        axes.set_theta_zero_location("N")  # type: ignore[attr-defined]
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        ring = np.linspace(0, 2 * np.pi, 361)
        floor, top = POLAR_RANGE
        edges = (floor, *(limit for limit, _ in CLASS_LIMITS), top)
        for (inner, outer), name in zip(
            pairwise(edges), ("high", "medium", "minimum", "none"), strict=True
        ):
            axes.fill_between(ring, inner, outer, color=CLASS_COLOURS[name], alpha=0.16, lw=0)
        if low is not None and high is not None:
            axes.fill_between(
                angle,
                np.clip(low[around], *POLAR_RANGE),
                np.clip(high[around], *POLAR_RANGE),
                color=INK,
                alpha=0.18,
                lw=0,
            )
        axes.plot(
            angle,
            np.clip(dgp_exceeded[around], *POLAR_RANGE),
            color=INK,
            lw=1.8,
            marker="o",
            ms=4,
            clip_on=False,
        )
        axes.set_ylim(floor, top)
        axes.set_yticks([0.35, 0.40, 0.45], ["0.35", "0.40", "0.45"], fontsize=8)
        axes.set_xticks(
            np.radians(np.arange(0, 360, 45)), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"]
        )
        axes.grid(color=PALE, lw=0.5)
        axes.spines["polar"].set_visible(False)
        return _svg(figure)


def exceedance_svg(
    dgp: Floats, occupied_hours: int, azimuths_deg: Floats, ends: Sequence[tuple[str, float]]
) -> str:
    """Plot the share of occupied hours in which each DGP is exceeded, one line for each direction.

    dgp: [n, d] of the hours with daylight; dark hours count as hours without glare, as in EN 17037.
    ends: name and azimuth of the worst and the best direction [deg]. Return the SVG as text.
    """
    n = len(dgp)
    share = 100.0 * np.arange(1, n + 1) / max(occupied_hours, 1)
    ranked = np.sort(dgp, axis=0)[::-1]
    with styled():
        figure = Figure(figsize=(5.6, 3.4))
        axes = figure.add_subplot()
        for limit, name in CLASS_LIMITS:
            axes.axhline(limit, color=CLASS_COLOURS[name], lw=1, ls="--")
            axes.text(30.2, limit, name, va="center", fontsize=8, color=CLASS_COLOURS[name])
        for i in range(dgp.shape[1]):
            axes.plot(share, ranked[:, i], color=PALE, lw=1)
        for (text, azimuth), colour in zip(ends, (CAPTURED, PREDICTED), strict=True):
            i = int(np.argmin(np.abs(azimuths_deg - azimuth)))
            label = f"{text}: {compass_name(azimuths_deg[i])} {azimuths_deg[i]:.0f}°"
            axes.plot(share, ranked[:, i], color=colour, lw=2, label=label)
        axes.axvline(5, color=INK, lw=0.8)
        axes.set(
            xlabel="share of occupied hours, %",
            ylabel="DGP exceeded",
            xlim=(0, 30),
            ylim=(0.15, None),
        )
        axes.legend(loc="upper right")
        return _svg(figure)


def agreement_svg(measured: Floats, predicted: Floats, quantity: str) -> str:
    """Plot predicted against measured values of the same shape, with the 1:1 line and r2.

    quantity: its name and unit, for the axes. r2: squared correlation, NaN for under three values
    or constant ones. Return SVG text.
    """
    x, y = np.ravel(measured), np.ravel(predicted)
    r2 = (
        float(np.corrcoef(x, y)[0, 1] ** 2)
        if len(x) > 2 and x.std() > 0 and y.std() > 0
        else float("nan")
    )
    span = [float(min(x.min(), y.min())), float(max(x.max(), y.max()))]
    with styled():
        figure = Figure(figsize=(3.6, 3.6))
        axes = figure.add_subplot()
        axes.plot(span, span, color=PALE, lw=1)
        axes.scatter(x, y, s=8, c=PREDICTED, alpha=0.5, lw=0)
        axes.set(xlabel=f"{quantity}, measured", ylabel=f"{quantity}, predicted", aspect="equal")
        known = "" if np.isnan(r2) else f"r² = {r2:.3f}, "
        axes.set_title(f"{known}n = {len(x)}", fontsize=9, loc="left")
        return _svg(figure)


def error_by_sun_svg(
    error: Floats, altitude_deg: Floats, azimuth_deg: Floats, quantity: str
) -> str:
    """Plot each hour's error [n] against the sun's altitude and azimuth [n], as SVG text.

    error: predicted minus measured; quantity: its name, for the axis.
    """
    with styled():
        figure = Figure(figsize=(7.4, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        left.scatter(altitude_deg, error, s=8, c=PREDICTED, alpha=0.6, lw=0)
        right.scatter(azimuth_deg, error, s=8, c=PREDICTED, alpha=0.6, lw=0)
        for axes in (left, right):
            axes.axhline(0, color=PALE, lw=1)
        left.set(xlabel="sun altitude, °", ylabel=f"{quantity}, predicted - measured")
        right.set(xlabel="sun azimuth, ° from north")
        return _svg(figure)


def contrast_levels_svg(measured: Floats, predicted: Floats) -> str:
    """Plot the mean over n maps of local contrast [n, levels] in cd/m2 by pyramid level, as SVG."""
    levels = np.arange(measured.shape[1])
    with styled():
        figure = Figure(figsize=(3.8, 3.0))
        axes = figure.add_subplot()
        axes.plot(levels, measured.mean(axis=0), color=CAPTURED, marker="o", label="measured")
        axes.plot(
            levels, predicted.mean(axis=0), color=PREDICTED, marker="s", ls="--", label="predicted"
        )
        axes.set(
            xlabel="detail: 0 one pixel, 4 sixteen pixels",
            ylabel="local contrast, cd/m²",
            xticks=levels,
        )
        axes.legend()
        return _svg(figure)
