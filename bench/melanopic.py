"""How far off melanopic EDI from camera colour is, under daylight, lamps and both.

Thirteen cameras of measured spectral sensitivities look at CIE daylight behind three glazings that
the coefficients have not seen, at the LEDs of CIE 015:2018, at halogen (Planck, 3000 K), at equal
parts of daylight and lamp, and at measured daylight. A chart under daylight or the colour matrix
that raw converters publish calibrates each. The uncertainties come from ten of the cameras.

    python bench/melanopic.py DATA            # DATA has camera_sensitivities and jeti_spectra
    python bench/melanopic.py DATA --chart fieldlum/calibrate/chart_daylight.csv
    python bench/melanopic.py DATA --lamps IESTM30_15_Sspds.dat   # nm, then a column a lamp
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from fieldlum.calibrate import colour
from fieldlum.calibrate.fit_charts import Place
from fieldlum.core.arrays import Floats
from fieldlum.optics import melanopic
from fieldlum.optics.profiles import load_camera_profile

UNSEEN = ("Hasselblad_H2", "Nokia_N900", "SONY_NEX-5N")  # chosen before the uncertainties
# XYZ to camera colours, times 10 000, under D65: the table of LibRaw and dcraw (Adobe's values).
MATRICES = {
    "Canon_40D": (6071, -747, -856, -7653, 15365, 2441, -2025, 2553, 7315),
    "Canon_500D": (4763, 712, -646, -6821, 14399, 2640, -1921, 3276, 6561),
    "Canon_5DMarkII": (4716, 603, -830, -7798, 15474, 2480, -1496, 1937, 6651),
    "Nikon_D3X": (7171, -1986, -648, -8085, 15555, 2718, -2170, 2512, 7457),
    "Nikon_D5100": (8198, -2239, -724, -4871, 12389, 2798, -1043, 2050, 7181),
    "Nikon_D700": (8139, -2171, -663, -8747, 16541, 2295, -1925, 2008, 8093),
    "Pentax_K-5": (8713, -2833, -743, -4342, 11900, 2772, -722, 1543, 6247),
    "SONY_NEX-5N": (5991, -1456, -455, -4764, 12135, 2980, -707, 1425, 6701),
}
TINTS = ("grey", "bronze")
TABLE = Path(__file__).with_suffix(".csv")
SPECTRA = np.genfromtxt(TABLE, delimiter=",", names=True, skip_header=9)
NM = SPECTRA["wavelength_nm"]
XYZ = np.stack([SPECTRA[name] for name in ("xbar", "ybar", "zbar")], axis=1)
PATCHES = np.stack([SPECTRA[f"patch_{i}"] for i in range(1, 25)])
SETTINGS = ("daylight", "daylight, 10 mm tinted glass", "daylight and lamp", "lamp")
SETTINGS += ("measured daylight",)
HEAD = "| light | mean, % | rms, % | largest, % | in the 95 % interval, % |\n|---|---|---|---|---|"


def daylight(cct_k: float) -> Floats:
    m = colour.daylight_parts(cct_k)
    return m[0] * SPECTRA["S0"] + m[1] * SPECTRA["S1"] + m[2] * SPECTRA["S2"]


def ratio(spectrum: Floats) -> Floats:
    """Melanopic over photopic light, 1 for D65."""

    def quotient(light: Floats) -> Floats:
        return light @ SPECTRA["s_mel"] / (light @ SPECTRA["ybar"])

    return quotient(spectrum) / quotient(daylight(6504.0))


def glass(kind: str, mm: float, panes: int = 1) -> Floats:
    """Transmittance of panes, by the absorption of Rubin 1985 and both reflections of each."""
    reflected = (0.52 / 2.52) ** 2
    inside = np.exp(-4 * np.pi * SPECTRA[f"k_{kind}"] * mm * 1e-3 / (NM * 1e-9))
    return ((1 - reflected) ** 2 * inside / (1 - (reflected * inside) ** 2)) ** panes


def planck(temperature_k: float) -> Floats:
    metres = NM * 1e-9
    return 1e-30 / (metres**5 * np.expm1(1.4388e-2 / (metres * temperature_k)))


def learned() -> Floats:
    """Spectra from which the coefficients come, each with luminance 1."""
    glazings = [np.ones_like(NM), glass("clear", 4, 2), glass("clear", 6, 2), glass("clear", 6, 3)]
    glazings += [glass("clear", 12, 2), glass("lowiron", 6, 2)]
    glazings += [glass("grey", 6), glass("bronze", 6)]
    walls = (np.ones_like(NM), 0.5 + 0.5 * PATCHES[1], 0.6 + 0.4 * PATCHES[6])
    temperatures = (*range(4000, 10_001, 500), *range(11_000, 25_001, 2000))
    light = [daylight(t) * g * w for t in temperatures for g in glazings for w in walls]
    return normalised(light)


def normalised(spectra: Iterable[Floats]) -> Floats:
    rows = np.array(list(spectra))
    return rows / (rows @ SPECTRA["ybar"])[:, None]


def held_out(jeti: Floats) -> dict[str, Floats]:
    glazings = (
        SPECTRA["t_comfort_select_r42"] * glass("clear", 6),
        SPECTRA["t_energy_advantage"] * glass("clear", 4),
        glass("green", 6),
    )
    day = [daylight(t) * g for t in (4000, 5000, 6500, 8000, 12_000, 20_000) for g in glazings]
    tinted = [daylight(t) * glass(k, 10) for t in range(4000, 20_001, 4000) for k in TINTS]
    lamps = [SPECTRA[name] for name in (SPECTRA.dtype.names or ()) if name.startswith("led")]
    day, lamps = normalised(day), normalised([*lamps, planck(3000.0)])
    both = mixed(day[6:9], lamps)
    sets = (day, normalised(tinted), both, lamps, normalised(jeti))
    return dict(zip(SETTINGS, sets, strict=True))


def mixed(day: Floats, lamps: Floats) -> Floats:
    """Each daylight with each lamp, of equal illuminance."""
    return normalised([a + b for a in day for b in lamps])


def more_lamps(path: Path, day: Floats) -> dict[str, Floats]:
    """Lamps of a table [wavelengths, 1 + lamps]: alone, and with equal parts of daylight."""
    nm, *columns = np.genfromtxt(path, delimiter=",").T
    lamps = normalised(np.interp(NM, nm, column, left=0, right=0) for column in columns)
    return {"more lamps": lamps, "daylight and more lamps": mixed(day, lamps)}


def read_jeti(folder: Path) -> Floats:
    path = next(folder.glob("*.cap"))
    lines = path.read_text(encoding="latin-1").splitlines()
    return np.array([[float(v) for v in line.split(";")[8:409:5]] for line in lines])


def read_cameras(folder: Path) -> dict[str, Floats]:
    """Sensitivities [wavelengths, 3] by camera."""
    cameras = {}
    for path in sorted(folder.glob("*.csv")):
        rows = [line for line in path.read_text().splitlines() if line[:1].isdigit()]
        nm, *rgb = np.array([[float(v) for v in row.split(",")] for row in rows]).T
        cameras[path.stem] = np.stack([np.interp(NM, nm, c, left=0, right=0) for c in rgb], axis=1)
    return cameras


def calibrated(
    sensitivity: Floats, matrix: tuple[int, ...] | None, cct_k: float, *, grey: bool = False
) -> tuple[Floats, Floats]:
    """Weights [3] of luminance and of melanopic luminance, by a chart with 1 % of noise.

    grey : the matrix gets the gains of the chart's white patch in daylight of cct_k.
    """
    rng = np.random.default_rng(int(cct_k))
    rgb = (PATCHES * daylight(cct_k)) @ sensitivity
    rgb = 50.0 * rgb / rgb.max() * (1 + 0.01 * rng.normal(size=rgb.shape))
    profile = load_camera_profile("sim-fisheye")
    places = tuple(Place(Path("chart"), i, 0) for i in range(24))
    colours = colour.Colours(rgb, colour.chart_xyz()[:, 1], np.full(24, 0.03), places)
    y = colour.fit(colours, profile).y_from_rgb
    if matrix is None:
        xyz = colour.xyz_from_chart(rgb, y, cct_k)
    else:
        of_grey = (rgb[18], cct_k) if grey else (rgb.mean(axis=0), None)
        xyz = colour.xyz_from_matrix(np.reshape(matrix, (3, 3)) / 1e4, y, *of_grey)
    return xyz[1], melanopic.MELANOPIC_FROM_XYZ @ xyz


def by_white_card(sensitivity: Floats, tint: str, seed: int) -> tuple[Floats, Floats, float]:
    """Weights as of `calibrated`, and their u: a chart, then four readings behind tinted glass.

    A spectrometer (u 2 %) reads one white card behind 10 mm of glass in daylight of four colours.
    """
    rng, profile = np.random.default_rng(seed), load_camera_profile("sim-fisheye")
    light = np.stack([daylight(k) * glass(tint, 10) for k in (5000.0, 6500.0, 9000.0, 14_000.0)])
    places = tuple(Place(Path("card"), i, 0) for i in range(24))
    of_chart = (PATCHES * daylight(6500.0)) @ sensitivity
    y = colour.chart_xyz(6500.0)[:, 1]
    of_chart *= 50.0 / of_chart.max() * (1 + 0.01 * rng.normal(size=(24, 3)))
    chart = colour.Colours(of_chart, y, np.full(24, 0.03), places, of_chart=True)
    new = replace(profile.colour, y_from_rgb=colour.fit(chart, profile).y_from_rgb)
    new, _ = colour.with_melanopic(new, chart, profile, 1.0, 6500.0)
    profile = replace(profile, colour=new)
    card = PATCHES[18] * light
    rgb = card @ sensitivity * (1 + 0.01 * rng.normal(size=(4, 3)))
    y = card @ SPECTRA["ybar"]
    y_read, melanopic_read = (v * (1 + 0.02 * rng.normal(size=4)) for v in (y, y * ratio(card)))
    parts = rgb * 50.0 / rgb.max(), y_read * 50.0 / y.max(), np.full(4, 0.02), places[:4]
    read = colour.Colours(*parts, melanopic=melanopic_read * 50.0 / y.max())
    fit = colour.fit(read, profile)
    new = replace(new, y_from_rgb=fit.y_from_rgb)
    new, _ = colour.with_melanopic(new, read, profile, fit.scale, None)
    return np.array(new.y_from_rgb), np.array(new.melanopic_from_rgb), new.melanopic_u_rel


def card_row(cameras: Iterable[Floats]) -> str:
    """One row of the table: daylight behind the glass where the card was read, six seeds."""
    errors, inside = [], []
    for sensitivity in cameras:
        for seed, tint in product(range(6), TINTS):
            y, weights, u = by_white_card(sensitivity, tint, seed)
            spectra = normalised(daylight(k) * glass(tint, 10) for k in range(4000, 20_001, 4000))
            rgb = spectra @ sensitivity
            estimate = rgb @ weights / (rgb @ y)
            off = estimate / ratio(spectra) - 1
            errors += off.tolist()
            inside += (np.abs(off) <= 1.96 * melanopic.ratio_u_rel(estimate, u)).tolist()
    return cells(SETTINGS[1], errors, inside)


def row(name: str, spectra: Floats, cases: list[tuple[Floats, Floats, Floats]], u: float) -> str:
    """One row of the table: errors of the ratio, and how often the 95 % interval holds it."""
    errors, inside = [], []
    for sensitivity, y, weights in cases:
        rgb = spectra @ sensitivity
        estimate = rgb @ weights / (rgb @ y) * (melanopic.LAMP_RATIO if "lamp" in name else 1.0)
        off = estimate / ratio(spectra) - 1
        u_rel = melanopic.ratio_u_rel(estimate, u, lamps="lamp" in name)
        errors += off.tolist()
        inside += (np.abs(off) <= 1.96 * u_rel).tolist()
    return cells(name, errors, inside)


def cells(name: str, errors: list[float], inside: list[bool]) -> str:
    off = 100 * np.array(errors)
    return (
        f"| {name} | {off.mean():+.1f} | {np.sqrt(np.mean(off**2)):.1f} | {np.abs(off).max():.1f} "
        f"| {100 * np.mean(inside):.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--chart", type=Path, help="write the chart's X, Y, Z under daylight here")
    parser.add_argument("--lamps", type=Path, help="spectra of more lamps")
    options = parser.parse_args()
    light = learned()
    relative = light @ XYZ / ratio(light)[:, None]
    fitted = np.linalg.lstsq(relative, np.ones(len(light)), rcond=None)[0]
    off = light @ XYZ @ fitted / ratio(light) - 1
    print(f"melanopic from X, Y, Z: {np.round(fitted, 4)}, rms {100 * off.std():.1f} %")
    print(f"lm per W of melanopic D65: {1e3 * ratio_lm():.4f} mW/lm (CIE S 026: 1.3262)")
    if options.chart:
        parts = [(PATCHES * SPECTRA[s]) @ XYZ for s in ("S0", "S1", "S2")]  # [24, 3] each
        write_chart(options.chart, np.stack(parts, axis=1))
    cameras = read_cameras(options.data / "camera_sensitivities")
    settings = held_out(read_jeti(options.data / "jeti_spectra"))
    if options.lamps:
        settings |= more_lamps(options.lamps, settings["daylight"][6:9])
    for title, u, matrices in (
        ("chart under daylight", melanopic.U_CHART, dict.fromkeys(cameras)),
        ("colour matrix only", melanopic.U_MATRIX, MATRICES),
        ("colour matrix and a white surface", melanopic.U_CHART, MATRICES),
    ):
        grey = "white" in title
        for group in (sorted(set(cameras) - set(UNSEEN)), UNSEEN):
            cases = [
                (cameras[name], *calibrated(cameras[name], matrices[name], cct_k, grey=grey))
                for name in group
                if name in matrices
                for cct_k in (5000.0, 6500.0)
            ]
            kind = "unseen" if group is UNSEEN else "used for u"
            print(f"\n{title}, {len(cases) // 2} cameras {kind}\n")
            print(HEAD)
            for name, spectra in settings.items():
                print(row(name, spectra, cases, u))

    for group in (sorted(set(cameras) - set(UNSEEN)), UNSEEN):
        print(f"\na white card behind 10 mm tinted glass, {len(group)} cameras\n\n{HEAD}")
        print(card_row(cameras[name] for name in group))


def ratio_lm() -> float:
    d65 = daylight(6504.0)
    return float(d65 @ SPECTRA["s_mel"] / (d65 @ SPECTRA["ybar"]) / 683.002)


def write_chart(path: Path, parts: Floats) -> None:
    """Write 24 rows: X, Y, Z of a patch under S0, S1 and S2 of CIE daylight."""
    head = (
        "X, Y, Z of the 24 patches of a chart under the components S0, S1 and S2 of CIE daylight\n"
        "from the mean reflectances of 30 charts (BabelColor 2012), by bench/melanopic.py"
    )
    np.savetxt(path, parts.reshape(24, 9), fmt="%.5g", delimiter=",", header=head)


if __name__ == "__main__":
    main()
