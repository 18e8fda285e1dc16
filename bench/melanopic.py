"""How far off melanopic EDI from camera colour is, under daylight, lamps and both.

Cameras of measured spectral sensitivities look at CIE daylight behind glazings that neither the
coefficients nor the uncertainties have seen, at the LED of CIE 015:2018, at halogen (Planck,
3000 K), at lamps of IES TM-30-15, at daylight with lamps, and at measured daylight. A chart under
daylight or the colour matrix that raw converters publish calibrates each. Three cameras and half of
the glazings and lamps are kept unseen. The first lines are the constants of the package.
The lamps' two files are in luxpy/data/spds of luxpy 1.12.5 (`pip download --no-deps luxpy`).

    python bench/melanopic.py DATA            # DATA has camera_sensitivities and jeti_spectra
    python bench/melanopic.py DATA --chart fieldlum/calibrate/chart_daylight.csv
    python bench/melanopic.py DATA --lamps IESTM30_15_Sspds.dat IESTM30_15_Sinfo.txt
    python bench/melanopic.py DATA --cameras FOLDER   # more sensitivities, for the constants
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

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
    "Canon_20D": (6599, -537, -891, -8071, 15783, 2424, -1983, 2234, 7462),
    "Canon_1DMarkIII": (6291, -540, -976, -8350, 16145, 2311, -1714, 1858, 7326),
    "Canon_300D": (8250, -2044, -1127, -8092, 15606, 2664, -2893, 3453, 8348),
    "Canon_50D": (4920, 616, -593, -6493, 13964, 2784, -1774, 3178, 7005),
    "Canon_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_60D": (6719, -994, -925, -4408, 12426, 2211, -887, 2129, 6051),
    "Nikon_D200": (8367, -2248, -763, -8758, 16447, 2422, -1527, 1550, 8053),
    "Nikon_D3": (8139, -2171, -663, -8747, 16541, 2295, -1925, 2008, 8093),
    "Nikon_D300s": (9030, -1992, -715, -8465, 16302, 2255, -2689, 3217, 8069),
    "Nikon_D40": (6992, -1668, -806, -8138, 15748, 2543, -874, 850, 7897),
    "Nikon_D50": (7732, -2422, -789, -8238, 15884, 2498, -859, 783, 7330),
    "Nikon_D80": (8629, -2410, -883, -9055, 16940, 2171, -1490, 1363, 8520),
    "Nikon_D90": (7309, -1403, -519, -8474, 16008, 2622, -2434, 2826, 8064),
    "Olympus_E-PL2": (15030, -5552, -1806, -3987, 12387, 1767, -592, 1670, 7023),
    "Pentax_Q": (11731, -4169, -1267, -2015, 10727, 1473, -217, 1492, 4870),
    "SONY_NEX-5N": (5991, -1456, -455, -4764, 12135, 2980, -707, 1425, 6701),
}
TINTS = ("grey", "bronze")
TABLE = Path(__file__).with_suffix(".csv")
SPECTRA = np.genfromtxt(TABLE, delimiter=",", names=True, skip_header=11)
NM = SPECTRA["wavelength_nm"]
XYZ = np.stack([SPECTRA[name] for name in ("xbar", "ybar", "zbar")], axis=1)
PATCHES = np.stack([SPECTRA[f"patch_{i}"] for i in range(1, 25)])
CCT_K = (4000, 5000, 6500, 8000, 12_000, 20_000)
CHART_K = (5000.0, 6500.0)
CARD = "grey or bronze glass, a white card read behind it"
HEAD = (
    "| light | mean, % | rms, % | 95 % are within, % | largest, % | in the 95 % interval, % "
    "| its half width, % |\n|---|---|---|---|---|---|---|"
)


class Setting(NamedTuple):
    """Light of a row, and what was stated about it."""

    spectra: Floats
    clear_glass: bool = False
    lamps: bool | None = None


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


def pane(name: str) -> Floats:
    """Transmittance of a coated pane and a clear one."""
    return SPECTRA[f"t_{name}"] * glass("clear", 6)


def clear_panes() -> list[Floats]:
    """Glazings for the uncertainties that a person may call clear, low-e or solar control."""
    coated = ("loe_180", "climaguard_premium2", "solarban_r67", "vne_63", "sb70_pacifica")
    return [np.ones_like(NM), glass("clear", 6), glass("clear", 6, 3), *map(pane, coated)]


def other_panes() -> list[Floats]:
    """Grey and bronze glass, a film, and a coating on grey glass, for the uncertainties."""
    thick = [glass(kind, 12) for kind in TINTS]
    thin = [glass(kind, 6) * glass("clear", 6) for kind in TINTS]
    return [*thin, *thick, SPECTRA["t_solar_bronze_20"], pane("stopray_titanium_34t")]


def behind(panes: Sequence[Floats]) -> Floats:
    return normalised([daylight(t) * g for t in CCT_K for g in panes])


def held_out(jeti: Floats) -> dict[str, Setting]:
    coated = SPECTRA["t_energy_advantage"] * glass("clear", 4)
    day = behind((pane("comfort_select_r42"), coated, glass("green", 6)))
    more = [pane(name) for name in ("solar_e_arctic_blue", "e366_sgp", "ve_12m")]
    more = behind([*more, SPECTRA["t_stratobel_iplus_top"], SPECTRA["t_float_4_8"]])
    tinted = behind([glass(kind, 10) for kind in TINTS])
    lamps = [SPECTRA[name] for name in (SPECTRA.dtype.names or ()) if name.startswith("led")]
    lamps = normalised([*lamps, planck(3000.0)])
    both = mixed(day[6:9], lamps)
    return {
        "daylight": Setting(day, True, False),
        "daylight, nothing stated": Setting(day),
        "five more glazings, one blue": Setting(more, True, False),
        "daylight, 10 mm grey or bronze glass": Setting(tinted, lamps=False),
        "half daylight, half lamp": Setting(both, True, True),
        "half daylight, half lamp, nothing stated": Setting(both),
        "lamp": Setting(lamps, True, True),
        "lamp, nothing stated": Setting(lamps),
        "measured behind electrochromic glass": Setting(normalised(jeti), lamps=False),
    }


def mixed(day: Floats, lamps: Floats, share: float = 0.5) -> Floats:
    """Each daylight with each lamp, which gives a share of the illuminance."""
    return normalised([(1 - share) * a + share * b for a in day for b in lamps])


LAMPS = ("LED", "Fluorescent", "Incandescent")


def read_lamps(table: Path, names: Path) -> tuple[Floats, list[str]]:
    """Lamps of IES TM-30-15, [lamps, wavelengths], and which of `LAMPS` each is."""
    nm, *columns = np.genfromtxt(table, delimiter=",").T
    kinds = [line.split(",")[2].strip() for line in names.read_text("latin-1").splitlines()[1:]]
    usual = [kind.startswith(LAMPS) for kind in kinds]
    rows = (np.interp(NM, nm, c, left=0, right=0) for c in np.array(columns)[usual])
    names_of = [next(name for name in LAMPS if k.startswith(name)) for k in np.array(kinds)[usual]]
    return normalised(rows), names_of


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
        return xyz_weights(colour.xyz_from_chart(rgb, y, cct_k), melanopic.MELANOPIC_FROM_XYZ)
    of_grey = (rgb[18], cct_k) if grey else (rgb.mean(axis=0), None)
    xyz = colour.xyz_from_matrix(np.reshape(matrix, (3, 3)) / 1e4, y, *of_grey)
    from_matrix = melanopic.BY_WHITE if grey else melanopic.BY_MATRIX
    return xyz_weights(xyz, from_matrix[0])


def xyz_weights(xyz: Floats, from_xyz: Floats) -> tuple[Floats, Floats]:
    return xyz[1], from_xyz @ xyz


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
    new = replace(new, y_from_rgb=fit.y_from_rgb, u_rel=fit.u_rel)
    new, _ = colour.with_melanopic(new, read, profile, fit.scale, None)
    return np.array(new.y_from_rgb), np.array(new.melanopic_from_rgb), new.melanopic_u_rel


def card_row(cameras: Iterable[Floats]) -> str:
    """One row of the table: daylight behind the glass where the card was read, six seeds."""
    off, u = [], []
    for sensitivity in cameras:
        for seed, tint in product(range(6), TINTS):
            y, weights, u_rel = by_white_card(sensitivity, tint, seed)
            spectra = behind([glass(tint, 10)])
            rgb = spectra @ sensitivity
            estimate = rgb @ weights / (rgb @ y)
            off += (estimate / ratio(spectra) - 1).tolist()
            u += melanopic.ratio_u_rel(estimate, u_rel, lamps=False).tolist()
    return cells(CARD, np.array(off), np.array(u))


Case = tuple[Floats, Floats, Floats]  # sensitivities, weights of luminance and melanopic luminance


def ratios(case: Case, spectra: Floats) -> Floats:
    """The camera's estimate."""
    sensitivity, y, weights = case
    rgb = spectra @ sensitivity
    return rgb @ weights / (rgb @ y)


def row(name: str, light: Setting, cases: list[Case], u: float) -> str:
    """One row of the table: errors of the ratio, and how often the 95 % interval holds it."""
    estimate = np.concatenate([ratios(case, light.spectra) for case in cases])
    estimate *= melanopic.LAMP_RATIO if light.lamps else 1.0
    off = estimate / np.tile(ratio(light.spectra), len(cases)) - 1
    if not light.clear_glass:
        u = float(np.hypot(u, melanopic.U_GLASS))
    return cells(name, off, melanopic.ratio_u_rel(estimate, u, lamps=light.lamps))


def cells(name: str, off: Floats, u: Floats) -> str:
    held = 100 * np.mean(np.abs(off) <= 1.96 * u)
    mean, rms, half = 100 * off.mean(), 100 * np.sqrt(np.mean(off**2)), 196 * u.mean()
    most, largest = 100 * np.quantile(np.abs(off), (0.95, 1.0))
    errors = f"{mean:+.1f} | {rms:.1f} | {most:.1f} | {largest:.1f}"
    return f"| {name} | {errors} | {held:.0f} | {half:.0f} |"


METHODS = (  # title, u behind clear glass, matrices, whether a white surface is read
    ("chart under daylight", melanopic.BY_CHART[1], None, False),
    ("colour matrix only", melanopic.BY_MATRIX[1], MATRICES, False),
    ("colour matrix and a white surface", melanopic.BY_WHITE[1], MATRICES, True),
)


def cases_of(
    cameras: Mapping[str, Floats],
    names: Iterable[str],
    matrices: Mapping[str, tuple[int, ...]] | None,
    grey: bool,
) -> dict[str, list[Case]]:
    """The calibrations of each camera by two daylights."""
    own = dict.fromkeys(names) if matrices is None else matrices
    return {
        name: [
            (cameras[name], *calibrated(cameras[name], own[name], k, grey=grey)) for k in CHART_K
        ]
        for name in names
        if name in own
    }


def print_constants(cameras: dict[str, Floats], lamps: Floats | None) -> None:
    """Print the coefficients, and what u has to be: 95 % over 1.96."""
    light = learned()
    fits = {"X, Y, Z": light @ XYZ / (light @ XYZ)[:, 1:2]}
    for title, spectra, white in (
        ("the matrix's", behind(clear_panes()[:6]), False),
        ("the matrix's and white", light, True),
    ):
        relative = []
        for name in sorted(set(MATRICES) & set(cameras) - set(UNSEEN)):
            y = calibrated(cameras[name], None, 6500.0)[0].tolist()
            rgb = (PATCHES * daylight(6500.0)) @ cameras[name]
            of_grey = (daylight(6500.0) @ cameras[name], 6500.0) if white else (rgb.mean(0), None)
            xyz = colour.xyz_from_matrix(np.reshape(MATRICES[name], (3, 3)) / 1e4, y, *of_grey)
            found = spectra @ cameras[name] @ xyz.T
            relative.append(found / found[:, 1:2] / ratio(spectra)[:, None])
        fits[f"{title} X, Y, Z ({len(relative)} cameras)"] = np.concatenate(relative)
    fits["X, Y, Z"] = fits["X, Y, Z"] / ratio(light)[:, None]
    for title, relative in fits.items():
        fitted = np.linalg.lstsq(relative, np.ones(len(relative)), rcond=None)[0]
        off = relative @ fitted - 1
        print(f"melanopic from {title}: {np.round(fitted, 4)}, rms {100 * off.std():.1f} %")
    print(f"lm per W of melanopic D65: {1e3 * ratio_lm():.4f} mW/lm (CIE S 026: 1.3262)")
    names = sorted(set(cameras) - set(UNSEEN))
    for title, _, matrices, grey in METHODS:
        known = cases_of(cameras, names, matrices, grey)
        for glazing, panes in (("clear", clear_panes()), ("other", other_panes())):
            worst = [0.0]
            for each in panes:
                spectra = behind([each])
                off = [
                    max(np.abs(ratios(case, spectra) / ratio(spectra) - 1).max() for case in cases)
                    for cases in known.values()
                ]
                worst.append(float(np.quantile(off, 0.95)) / 1.96)
            print(f"u, {title}, {len(known)} cameras, {glazing} glass: {100 * max(worst):.1f} %")
    if lamps is not None:
        known = cases_of(cameras, names, None, False)
        print_lamps([case for each in known.values() for case in each], lamps)


def print_lamps(cases: list[Case], lamps: Floats) -> None:
    """Print what u has to be by the estimated ratio, for the odd lamps with used daylight."""
    half, day = lamps[::2], behind([*clear_panes()[1:], glass("grey", 6)])[::3]
    for light in (0.25, 0.5, 0.75, 1.0):
        spectra = half if light == 1.0 else mixed(day, half, light)
        estimate = np.concatenate([ratios(case, spectra) for case in cases[::3]])
        true = np.tile(ratio(spectra), len(cases[::3]))
        texts = []
        for low in np.arange(0.3, 1.25, 0.1):
            near = (estimate >= low) & (estimate < low + 0.1)
            if near.sum() > 20:
                off = estimate[near] / true[near] - 1
                texts.append(f"{low + 0.05:.2f}: {100 * np.quantile(np.abs(off), 0.95) / 1.96:.0f}")
        print(f"u, {100 * light:.0f} % lamp, by ratio, %: {', '.join(texts)}")
        print(f"  mean of true over estimated ratios {np.mean(true / estimate):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--chart", type=Path, help="write the chart's X, Y, Z under daylight here")
    parser.add_argument("--lamps", type=Path, nargs=2, help="spectra of lamps, and their kinds")
    parser.add_argument("--cameras", type=Path, help="more sensitivities")
    options = parser.parse_args()
    if options.chart:
        parts = [(PATCHES * SPECTRA[s]) @ XYZ for s in ("S0", "S1", "S2")]  # [24, 3] each
        write_chart(options.chart, np.stack(parts, axis=1))
    cameras = read_cameras(options.data / "camera_sensitivities")
    more = read_cameras(options.cameras) if options.cameras else {}
    lamps, kinds = read_lamps(*options.lamps) if options.lamps else (None, [])
    print_constants(more | cameras, lamps)
    settings = held_out(read_jeti(options.data / "jeti_spectra"))
    if lamps is not None:
        day = settings["daylight"].spectra[6:9]
        for stated, light in (("", (True, True)), (", nothing stated", (False, None))):
            settings[f"other half of TM-30's lamps{stated}"] = Setting(lamps[1::2], *light)
            half = Setting(mixed(day, lamps[1::2]), *light)
            settings[f"half daylight, half one of these{stated}"] = half
        for kind in LAMPS:
            own = lamps[1::2][np.array(kinds[1::2]) == kind]
            name = f"half daylight, half {len(own)} of these, {kind}"
            settings[name] = Setting(mixed(day, own), True, True)
    groups = (("used for u", sorted(set(cameras) - set(UNSEEN))), ("unseen", UNSEEN))
    for title, u, matrices, grey in METHODS:
        for kind, names in groups:
            known = cases_of(cameras, names, matrices, grey)
            print(f"\n{title}, {len(known)} cameras {kind}\n\n{HEAD}")
            for name, light in settings.items():
                print(row(name, light, [case for each in known.values() for case in each], u))
            if matrices is None:
                print(card_row(cameras[name] for name in names))


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
