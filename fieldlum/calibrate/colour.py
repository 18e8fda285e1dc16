"""Fit three coefficients from camera colours to luminance, by spot readings or a 24-patch chart.

The fit starts from the profile's coefficients or the frames' colour matrix, and changes them as far
as the readings support it.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place
from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.strict_csv import lines_of, read_number, read_text
from fieldlum.optics import images, melanopic
from fieldlum.optics.profiles import CameraProfile, Colour

# Weights of the prior relative to one reading, from strong to weak, of which held-out readings
# select one.
PULLS = (np.inf, 1.0, 0.1, 0.01)
MIN_READINGS = 4  # three coefficients, and one reading to hold out
# Corners that are stated in another order leave a misfit of 0.5 and more, uneven light up to 0.2.
# Chosen between.
_MAX_MISFIT = 0.4
_WEIGHTS = Path(__file__).with_name("melanopic_weights.csv")
_SPECTRUM = re.compile(r"Spectral Values \((\d+) nm - (\d+) nm\)\s*;(.*)")
_CHART_XYZ = Path(__file__).with_name("chart_daylight.csv")  # written by bench/melanopic.py


@dataclass(frozen=True, slots=True)
class Colours:
    """Camera colours and luminances of n readings.

    rgb [n, 3]: linear camera colours, corrected for vignetting, converted to cd/m2 by the profile's
    scale k (`profiles.Scale`). of_chart: whether the places are a chart's patches; it decides the
    unit of y [n], the luminances Y of the same places: True: by the chart, in % of its white patch;
    False: by a meter, in cd/m2. u_rel [n]: relative standard uncertainty of comparing rgb with y;
    places [n]: where they are; matrix [3, 3]: XYZ to camera colours, None if the frames do not
    state it. melanopic [n]: melanopic equivalent daylight luminances by a spectrometer [cd/m2], or
    None.
    """

    rgb: Floats
    y: Floats
    u_rel: Floats
    places: tuple[Place, ...]
    matrix: Floats | None = None
    melanopic: Floats | None = None
    of_chart: bool = False


class ColourFit(NamedTuple):
    """Fitted coefficients from camera colours to luminance, with uncertainty and residuals.

    y_from_rgb: weights of R, G, B in the luminance. scale: readings divided by the luminance by
    y_from_rgb, a factor on k that y_from_rgb does not contain (of a chart in the unit of its y).
    residual [n]: (luminance by camera, with `scale`) / reading - 1, also for omitted readings.
    u_rel: relative rms of the held-out errors. choice: how the number of coefficients was chosen.
    """

    y_from_rgb: tuple[float, float, float]
    scale: float
    u_rel: float
    residual: Floats
    choice: fit_steps.OrderSelection


# ----------------------------------------------------------------------------------------------
# readings


def from_table(path: Path, profile: CameraProfile) -> Colours:
    """Read spot readings from a csv with the columns file, x_px, y_px and luminance_cdm2.

    x_px, y_px: place of the reading on the sensor. Optional columns: radius_px of the averaged disc
    (default 12), u_rel of the reading (default 0.02) and melanopic_cdm2, its melanopic equivalent
    daylight luminance, in all rows or none. The profile's vignetting is corrected. A column
    spectrum with files of a JETI spectrometer (`read_spectrum`) replaces luminance_cdm2 and
    melanopic_cdm2. Paths are relative to the csv. Raises InputError for an invalid csv, an
    unreadable frame or spectrum, an aperture without a vignetting curve, or a place that is clipped
    or outside the picture.
    """
    extra = [name for name in ("melanopic_cdm2", "spectrum") if name in fit_steps.columns_of(path)]
    light = extra if "spectrum" in extra else ["luminance_cdm2", *extra]
    required = ("file", "x_px", "y_px", *light)
    rows = fit_steps.read_table(path, required, {"radius_px": 12.0, "u_rel": fit_steps.READING_U})
    files = dict.fromkeys(row["file"] for row in rows)
    frames = {file: fit_steps.linear_frame(file, profile) for file in files}
    places = tuple(Place(row["file"], row["x_px"], row["y_px"]) for row in rows)
    patches = [
        _patch(frames[place.path], place, row["radius_px"], row["u_rel"], profile)
        for place, row in zip(places, rows, strict=True)
    ]
    rgb, u_rel = (np.array(values) for values in zip(*patches, strict=True))
    if "spectrum" in extra:
        figures = np.array([read_spectrum(row["spectrum"]) for row in rows]).T
    else:
        figures = fit_steps.columns(rows, *light)
    y, *edi = figures
    matrix = next((f.colour_matrix for f in frames.values() if f.colour_matrix is not None), None)
    return Colours(rgb, y, u_rel, places, matrix, edi[0] if edi else None)


def read_spectrum(path: Path) -> tuple[float, float]:
    """Return luminance and melanopic equivalent daylight luminance by a JETI spectrometer's file.

    Both are in cd/m2. Each line has `Spectral Values (380 nm - 1000 nm)`, then the values between
    semicolons, of radiance [W/(m2 sr nm)]; the result [cd/m2] is the mean of the lines. Irradiance
    gives lx. Raises InputError for a file without a spectrum, or with an incomplete one.
    """
    # wavelength, luminous efficiency V, melanopic sensitivity; the factors are those of CIE S
    # 026:2018: 683.002 lm/W, and 1.3262 mW/lm of daylight D65
    nm, v, s_mel = np.loadtxt(_WEIGHTS, delimiter=",").T
    weights = np.stack([683.002 * v, s_mel / 1.3262e-3]) * (nm[1] - nm[0])
    figures = []
    expected = "lines with 'Spectral Values (380 nm - 1000 nm);' and a number for each 1 or 5 nm"
    remedy = "export it again from JETI LiVal"
    with input_errors(path, expected, remedy, ValueError):
        content = "\n".join(lines_of(read_text(path, "a file of a spectrometer")))
        for low, high, text in _SPECTRUM.findall(content):
            cells = [cell.strip().replace(",", ".") for cell in text.split(";") if cell.strip()]
            values = [read_number(cell, has_codes=False) for cell in cells]
            if not np.isfinite(values).all():
                raise ValueError("a spectrum with missing numbers")
            own_nm = np.linspace(float(low), float(high), len(values))
            if len(values) < 2 or own_nm[1] - own_nm[0] not in (1.0, 5.0):  # a cut line
                raise ValueError(f"{len(values)} numbers from {low} to {high} nm")
            figures.append(weights @ np.interp(nm, own_nm, values))
    if not figures:
        raise InputError(path, "no spectrum", expected, remedy)
    y, edi = np.mean(figures, axis=0).tolist()
    return y, edi


def _patch(
    frame: fit_steps.LinearFrame, at: Place, radius_px: float, u_rel: float, profile: CameraProfile
) -> tuple[Floats, float]:
    """Return the colour [3] of a patch, corrected for vignetting, and the relative u of a reading.

    at, radius_px: centre and radius of the patch; u_rel: relative u of the meter's reading or of
    the chart's patch. The result's u also has that of the patch in the frame.
    """
    rgb, u_patch = frame.patch(at.x, at.y, radius_px)
    transmission = fit_steps.transmission(profile, frame.exposure.f_number, at.x, at.y)
    return rgb / transmission, float(np.hypot(u_rel, u_patch))


def from_chart(
    path: Path, profile: CameraProfile, corners_px: Sequence[float] = (), cct_k: float = 6500.0
) -> Colours:
    """Read a 24-patch chart in a frame that is lit evenly, by daylight of cct_k.

    corners_px: x and y of the outer corners of the field of patches, top left (dark skin), top
    right, bottom right (black), bottom left; empty if OpenCV searches the chart. cct_k: correlated
    colour temperature [K]. Raises InputError for an unreadable frame, a patch that is clipped or
    outside the picture, if no chart is detected, or if its patches are not in the order of a chart;
    ValueError for a cct_k outside 4000 to 25 000 K.
    """
    frame = fit_steps.linear_frame(path, profile)
    corners = np.reshape(corners_px, (4, 2)) if len(corners_px) else find_chart(frame)
    centres, radius = patch_centres(corners)
    places = tuple(Place(path, x, y) for x, y in centres.tolist())
    # 3 %: between the mean Y of patches in two publications
    patches = [_patch(frame, place, radius, 0.03, profile) for place in places]
    rgb, u_rel = (np.array(values) for values in zip(*patches, strict=True))
    if misfit(rgb) > _MAX_MISFIT:
        finding = "the 24 patches do not have a chart's colours in a chart's order"
        expected = "--corners clockwise from the corner at the dark skin (brown) patch"
        raise InputError(path, finding, expected, "state --corners again")
    y = chart_xyz(cct_k)[:, 1]
    return Colours(rgb, y, u_rel, places, frame.colour_matrix, of_chart=True)


# ----------------------------------------------------------------------------------------------
# fit


def _priors(colours: Colours, profile: CameraProfile) -> dict[str, Floats]:
    """Return the coefficients [3] of R, G, B in luminance towards which a fit may pull, by name.

    These are the profile's y_from_rgb and, if the frames state a colour matrix, the Y row of its
    inverse (camera to XYZ), scaled to give the mean colour of the readings the same luminance.
    """
    own = np.array(profile.colour.y_from_rgb)
    starts = {"the profile's coefficients": own}
    if colours.matrix is not None:
        row, grey = np.linalg.inv(colours.matrix)[1], colours.rgb.mean(axis=0)
        starts["the file's colour matrix"] = row * float(own @ grey) / float(row @ grey)
    return starts


def fit(colours: Colours, profile: CameraProfile) -> ColourFit:
    """Fit the coefficients of R, G, B in luminance by ridge regression towards a prior.

    Leave-one-out errors choose the prior and the weight of the ridge. The new coefficients give the
    mean colour of the readings the same luminance as the prior does: only their proportion is
    fitted here. The absolute factor belongs to `calibrate scale` and is returned separately, as
    `scale`. Gross errors of readings are omitted and listed in the choice's line. Raises
    NotEnoughDataError for fewer than four readings, InputError for readings that are not positive
    or do not fit the colours.
    """
    fit_steps.require(len(colours.y), MIN_READINGS, "readings", "add readings of other colours")
    source = colours.places[0].path
    if min(colours.y.min(), colours.rgb[:, 1].min()) <= 0:
        remedy = "remove its line from the csv, or use a frame with a longer exposure"
        raise InputError(source, "a reading or a patch of 0 or less", "values above 0", remedy)
    starts, every = _priors(colours, profile), colours
    colours, left_out = _without_outliers(colours, list(starts.values()))
    (prior, _), raw, choice = fit_steps.fit_and_choose(
        "colour",
        [
            (f"{name}, weight {pull:g}", size, (start, pull))
            for name, start in starts.items()
            for size, pull in enumerate(PULLS)
        ],
        np.arange(len(colours.y)),
        lambda model, rows: _solve(colours, *model, rows),
        lambda _, a, held: (colours.rgb[held] @ a / colours.y[held] - 1.0) ** 2,
    )
    if choice.rms > 0.2:  # readings and colours do not belong together
        finding = f"held-out readings do not fit the colours (error {100 * choice.rms:.0f} %)"
        remedy = "check the place of each reading, and that the light was steady"
        raise InputError(source, finding, "at most 20 %", remedy)
    grey = (colours.rgb / (colours.rgb @ prior)[:, None]).mean(axis=0)
    scale = float(raw @ grey) / float(prior @ grey)
    red, green, blue = np.round(raw / scale, 6).tolist()
    residual = every.rgb @ raw / every.y - 1.0
    choice = replace(choice, line=choice.line + left_out)
    return ColourFit((red, green, blue), scale, max(choice.rms, 0.001), residual, choice)


def _without_outliers(colours: Colours, priors: Sequence[Floats]) -> tuple[Colours, str]:
    """Return the colours without gross errors of readings, and a text on the omitted readings.

    A gross error is a wrong factor, such as a decimal point or another unit. At most a quarter of
    the readings is omitted. priors: coefficients [3] each; the one with the smallest deviations
    decides.
    """
    ratios = [colours.rgb @ prior / colours.y for prior in priors]
    offs = [np.log(np.where(ratio > 0.0, ratio, np.median(ratio))) for ratio in ratios]
    # of the prior with the smallest deviations from its median
    off = min((o - np.median(o) for o in offs), key=lambda o: float(np.median(np.abs(o))))
    far = fit_steps.gross_errors(off, 0.5)  # ln of luminance: further away is a wrong factor
    if not far.any() or (~far).sum() < MIN_READINGS:
        return colours, ""
    notes = [
        f"{at.path.stem} {at.x:g},{at.y:g}, {np.exp(-o):.2g} times the value by the others"
        for at, o, is_far in zip(colours.places, off, far, strict=True)
        if is_far
    ]
    near = {name: getattr(colours, name)[~far] for name in ("rgb", "y", "u_rel")}
    return replace(colours, **near), f"; left out: {'; '.join(notes)}"


def _solve(colours: Colours, prior: Floats, pull: float, rows: Mask) -> Floats:
    """Return the coefficients a [3] of R, G, B by ridge regression of the readings `rows`.

    They minimise sum ((a . rgb / y - 1) / u)^2 + n pull / u^2 |share * (a - s prior)|^2, where n is
    the number of readings, share the mean part of each colour in the luminance, and s the scale
    with which the prior fits best. With an infinite pull the result is s * prior.
    """
    u = colours.u_rel[rows]
    relative = colours.rgb[rows] / colours.y[rows][:, None]
    weighted = relative @ prior / u
    s = float(weighted @ (1.0 / u) / (weighted @ weighted))
    if np.isinf(pull):
        return s * prior
    share = np.diag(relative.mean(axis=0) * np.sqrt(len(u) * pull) / np.median(u))
    design = np.concatenate([relative / u[:, None], share])
    return np.linalg.lstsq(design, np.concatenate([1.0 / u, share @ (s * prior)]), rcond=None)[0]


# ----------------------------------------------------------------------------------------------
# XYZ and melanopic weight


def xyz_from_chart(rgb: Floats, y_from_rgb: Sequence[float], cct_k: float) -> Floats:
    """Return the matrix from camera colours to X, Y, Z by a chart under daylight, [3, 3].

    rgb: camera colours of the 24 patches [24, 3], in any unit, under CIE daylight of the correlated
    colour temperature cct_k, 4000 to 25 000 K. Y is that of y_from_rgb. The level of each patch is
    its own luminance by the camera, so that uneven light does no harm. Raises ValueError for
    another cct_k.
    """
    patches = chart_xyz(cct_k)
    # The greys, patches 19 to 24, have the colour of the daylight itself.
    weight = np.where(np.arange(24) < 18, 1.0, 10.0)[:, None]
    relative = weight * rgb / (rgb @ np.array(y_from_rgb))[:, None]
    matrix = np.linalg.lstsq(relative, weight * patches / patches[:, 1:2], rcond=None)[0].T
    matrix[1] = y_from_rgb
    return matrix


def chart_xyz(cct_k: float = 6500.0) -> Floats:
    """Return X, Y, Z of a chart's patches under CIE daylight, [24, 3]; the white patch has Y 100.

    cct_k: correlated colour temperature of the daylight [K]. Mean reflectances of 30 charts
    (BabelColor 2012); Y differs by 3 % rms from McCamy 1976. Patches are row by row from dark skin
    to black. Raises ValueError for a cct_k outside 4000 to 25 000 K.
    """
    table = np.loadtxt(_CHART_XYZ, delimiter=",").reshape(24, 3, 3)  # patch, S0 to S2, XYZ
    patches = daylight_parts(cct_k) @ table
    return 100.0 * patches / patches[18, 1]


def daylight_parts(cct_k: float) -> Floats:
    """Return the weights of the CIE's components S0, S1 and S2 of daylight, [3].

    Formulas: CIE 15. cct_k: correlated colour temperature of the daylight [K]. Raises ValueError
    for one outside 4000 to 25 000 K.
    """
    if not 4000.0 <= cct_k <= 25_000.0:
        raise ValueError(f"{cct_k:g} K: CIE daylight is defined from 4000 to 25 000 K")
    x, y = melanopic.daylight_xy(cct_k)
    m = 0.0241 + 0.2562 * x - 0.7341 * y  # M, M1 and M2 of CIE 15
    m1 = (-1.3515 - 1.7703 * x + 5.9114 * y) / m
    m2 = (0.0300 - 31.4424 * x + 30.0717 * y) / m
    return np.array([1.0, m1, m2])


def xyz_from_matrix(
    matrix: Floats, y_from_rgb: Sequence[float], grey: Floats, cct_k: float | None = None
) -> Floats:
    """Return the matrix from camera colours to X, Y, Z by the colour matrix of a raw file, [3, 3].

    matrix: XYZ to camera colours. y_from_rgb: becomes the row of Y. grey [3]: the camera colour
    whose luminance by the colour matrix is scaled to that by y_from_rgb. cct_k: correlated colour
    temperature of the daylight if `grey` is the colour of a grey surface in it: the channels then
    get the gains that make it grey, as DNG's CameraCalibration does; None for another colour.
    Raises ValueError if a gain is over 1.5 times the green one, or under 1 / 1.5 of it.
    """
    inverse = np.linalg.inv(matrix)
    if cct_k is not None:
        x, y = melanopic.daylight_xy(cct_k)
        gains = matrix @ np.array([x, y, 1.0 - x - y]) / grey
        if max(gains / gains[1]) > 1.5 or min(gains / gains[1]) < 1 / 1.5:
            raise ValueError(f"gains of {gains / gains[1]} on a surface that should be grey")
        inverse = inverse * gains
    inverse *= float(np.dot(y_from_rgb, grey)) / float(inverse[1] @ grey)
    inverse[1] = y_from_rgb
    return inverse


def with_melanopic(
    colour: Colour,
    colours: Colours,
    profile: CameraProfile,
    scale: float,
    cct_k: float | None,
    clear_glass: bool = False,
) -> tuple[Colour, str]:
    """Return the profile's colours with a melanopic weight, and a line on where they are from.

    colour: the profile's table with the fitted y_from_rgb and its u. colours: the readings; scale:
    `ColourFit.scale` of the fit to them. cct_k: correlated colour temperature of the daylight on a
    chart, or on the grey first reading, None if unknown. clear_glass: the camera's rooms have no
    grey or bronze glass and no film. X, Y, Z come from the chart, else from the colour matrix in
    the frames. The weight follows from X, Y, Z, and from readings of a spectrometer if there are
    any. Without any of these, the table has none. Raises InputError if the grey reading is not grey
    in that daylight, for cct_k without a chart or a colour matrix, and as `fit` for readings of a
    spectrometer; ValueError as `chart_xyz`.
    """
    # `origin`: the weights of X, Y, Z and their relative uncertainty, by where the colours are from
    origin, to_xyz = melanopic.BY_MATRIX, images.rgb_to_xyz(images.RADIANCE_CHROMATICITIES)
    if cct_k is not None and colours.of_chart:
        xyz, origin = xyz_from_chart(colours.rgb, colour.y_from_rgb, cct_k), melanopic.BY_CHART
        line = f"melanopic: chart under daylight of {cct_k:g} K"
    elif colours.matrix is not None:
        grey, line = colours.rgb.mean(axis=0), "melanopic: the file's colour matrix"
        if cct_k is not None:
            grey, origin = colours.rgb[0], melanopic.BY_WHITE
            line += f", with a grey surface in daylight of {cct_k:g} K"
        expected = "a grey or white surface in daylight as the first reading"
        with input_errors(colours.places[0].path, expected, "correct it or --cct", ValueError):
            xyz = xyz_from_matrix(colours.matrix, colour.y_from_rgb, grey, cct_k)
    elif cct_k is not None:
        found, expected = "no colour matrix in the frame", "a raw frame with one, or a chart"
        raise InputError(colours.places[0].path, found, expected, "omit --cct")
    elif colours.melanopic is not None and colour.rgb_to_radiance:
        xyz = to_xyz @ np.reshape(colour.rgb_to_radiance, (3, 3))
        xyz[1], line = colour.y_from_rgb, "melanopic: the profile's colours"
    else:
        none = replace(colour, melanopic_from_rgb=(), melanopic_u_rel=0.0)
        return none, "melanopic: none; use a chart with --cct, or raw frames with a colour matrix"
    weights, u_rel = origin[0] @ xyz, origin[1]
    if colours.melanopic is not None:
        start = replace(profile.colour, y_from_rgb=tuple(weights.tolist()))
        read = replace(colours, y=colours.melanopic, matrix=None)
        read_fit = fit(read, replace(profile, colour=start))
        weights = np.array(read_fit.y_from_rgb) * read_fit.scale / scale
        # the ratio has the errors of both readings
        u_rel = float(np.hypot(*np.maximum((read_fit.u_rel, colour.u_rel), fit_steps.READING_U)))
        line = f"{line}, then {len(read.y)} readings"
    elif not clear_glass:
        u_rel = float(np.hypot(u_rel, melanopic.U_GLASS))
        line += "; glass not stated (--clear-glass)"
    table = replace(
        colour,
        rgb_to_radiance=tuple(np.round(np.linalg.inv(to_xyz) @ xyz, 6).ravel().tolist()),
        melanopic_from_rgb=tuple(np.round(weights, 6).tolist()),
        melanopic_u_rel=round(u_rel, 4),
    )
    return table, f"{line}; relative uncertainty {100 * u_rel:.1f} % under daylight"


# ----------------------------------------------------------------------------------------------
# the chart in a frame

ROWS, COLUMNS = 4, 6


def misfit(rgb: Floats) -> float:
    """Return the rms relative difference of 24 camera colours from those of a chart.

    rgb: [24, 3], linear, in any unit, row by row from the dark skin patch. The 3 x 3 matrix that
    fits camera colours best to the chart's is applied first. 0 is a perfect chart; the colours in
    another order give 0.5 and more.
    """
    chart = chart_xyz() / 100.0
    weight = 1.0 / (chart.mean(axis=1, keepdims=True) + 0.03)
    camera = np.asarray(rgb, float) / max(float(np.max(rgb)), 1e-12)
    matrix = np.linalg.lstsq(camera * weight, chart * weight, rcond=None)[0]
    return float(np.sqrt(np.mean(((camera @ matrix - chart) * weight) ** 2)))


def patch_centres(corners: Floats) -> tuple[Array, float]:
    """Return the centres of a chart's patches, x and y [24, 2] px, and the radius to average [px].

    corners: x and y [4, 2] px of the outer corners of the field of patches, clockwise from the
    corner at the dark skin patch. Centres are row by row from that patch.
    """
    square = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], np.float32)
    h = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    down, right = np.mgrid[:ROWS, :COLUMNS].reshape(2, -1) + 0.5
    centres = cv2.perspectiveTransform(np.stack([right, down], axis=1)[None], h)[0]
    gap = (np.linalg.norm(centres[1] - centres[0]), np.linalg.norm(centres[COLUMNS] - centres[0]))
    return centres, 0.25 * float(min(gap))


def find_chart(frame: fit_steps.LinearFrame) -> Floats:
    """Return the corners of the chart that OpenCV detects, x and y [4, 2] sensor px.

    Their order is that of the argument of `patch_centres`.

    Raises InputError if no chart is detected, or none whose colours are in a chart's order.
    """
    light = frame.rgb / max(float(np.percentile(frame.rgb[..., 1], 99)), 1e-9)
    codes = (255 * np.clip(light[..., ::-1], 0, 1) ** (1 / 2.2)).astype(np.uint8)
    shrink = min(1.0, 1600 / max(codes.shape))  # the detector's time grows with the picture
    picture = cv2.resize(codes, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    detector: Any = cv2.mcc.CCheckerDetector_create()  # type: ignore[attr-defined]
    kind = cv2.mcc.MCC24  # type: ignore[attr-defined]
    if hasattr(detector, "setColorChartType"):  # OpenCV 5, which has no default of it
        detector.setColorChartType(kind)
        detector.process(picture, 3)
    else:
        detector.process(picture, kind, 3)
    boxes = [np.asarray(chart.getBox(), float) for chart in detector.getListColorChecker()]
    # each box may begin at any of its four corners
    ways = [np.roll(box, turn, axis=0) * frame.step / shrink for box in boxes for turn in range(4)]

    def misfit_of(corners: Floats) -> float:
        """Return the misfit of a chart with these corners; infinite if a patch is unusable."""
        with suppress(InputError):  # a patch outside the picture, or clipped
            centres, radius_px = patch_centres(corners)
            return misfit(np.array([frame.patch(x, y, radius_px)[0] for x, y in centres.tolist()]))
        return np.inf

    misfits = list(map(misfit_of, ways))
    if min(misfits, default=np.inf) > _MAX_MISFIT:
        remedy = "state the chart's corners with --corners"
        raise InputError(frame.path, "no colour chart found", "a 24-patch chart", remedy)
    return ways[int(np.argmin(misfits))]


def chart(colours: Colours, fit: ColourFit) -> Chart:
    """Return a chart of the readings of the patches, and of their luminance by the fit."""
    new = colours.rgb @ np.array(fit.y_from_rgb) * fit.scale
    title = f"colour to luminance; held-out rms {100 * fit.u_rel:.2g} %"
    y = ("reading, or chart [%]", colours.y)
    return Chart(title, -fit.residual, colours.places, y=y, fitted=new)
