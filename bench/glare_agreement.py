"""Our all-direction glare against evalglare, on a stratified sample of view-hours.

Usage: python bench/glare_agreement.py MAPS.npz [--per-stratum 40] [--size 800] [--out TABLE.csv]

MAPS.npz: `lum` and `sunpatch` uint16 [n, H, W] as 10 ** (q / 65535 * 9 - 0.5) cd/m2, `conditions`
[n, 18] whose last three columns are the sun's direction (x east, y north, z up); heading south. The
disc is one pixel of `sunpatch`: it is taken out of the map here and handed to both sides as a
source. Strata: sun in view, low light (Ev < 300 lx), reflections (bright pixels off the window, no
sun in view), and the rest.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np

from fieldlum.core.records import SunSource
from fieldlum.optics.projection import (
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
    row_solid_angles,
)
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.year.glare.metrics import dgp, glare_directions
from fieldlum.year.glare.pictures import panorama_to_fisheye, reference_glare, reference_version
from fieldlum.year.glare.sources import (
    angles_from_view,
    panorama_views,
    position_index,
    view_azimuths_deg,
    view_frame,
)

HEADING_DEG = 180.0
DISC_CDM2 = 1e5
STRATA = ("sun in view", "low light", "reflections", "other")


def load(path: Path) -> dict[str, np.ndarray]:
    """Maps without the disc, the disc's illuminance, sun directions."""
    data = np.load(path)
    decode = lambda q: np.where(q > 0, 10.0 ** (q.astype(np.float64) / 65535 * 9 - 0.5), 0.0)  # noqa: E731
    luminance = decode(data["lum"])
    patch = decode(data["sunpatch"])
    n, height, width = luminance.shape
    omega = row_solid_angles(height, width)[:, None]
    sun = data["conditions"][:, -3:]
    lux = np.zeros(n)
    for i in range(n):
        row, column = equirect_pixel(
            np.degrees(np.arcsin(sun[i, 2])),
            np.degrees(np.arctan2(sun[i, 0], sun[i, 1])),
            height,
            width,
            HEADING_DEG,
        )
        r, c = int(row), int(column)
        box = np.s_[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        disc = patch[i][box] > DISC_CDM2
        if disc.any():
            surround = np.median(luminance[i][max(r - 3, 0) : r + 4, max(c - 3, 0) : c + 4])
            excess = np.where(disc, luminance[i][box] - surround, 0.0)
            lux[i] = float(
                (excess * np.broadcast_to(omega[max(r - 1, 0) : r + 2], disc.shape)).sum()
            )
            luminance[i][box] = np.where(disc, surround, luminance[i][box])
    return {"luminance": luminance.astype(np.float32), "disc_lx": lux, "sun": sun}


def additive_dgp(
    image: np.ndarray, ev: float, heading_deg: float, azimuth: float, sun: np.ndarray, lux: float
) -> float:
    """DGP with every bright pixel as a source of its own: what grouping is worth."""
    height, width = image.shape
    right, up, cosine = angles_from_view(
        equirect_rays(height, width, heading_deg), view_frame(azimuth)
    )
    seen = (image > 2000) & (cosine > 0)
    weight = equirect_solid_angles(height, width)[seen] / position_index(right[seen], up[seen]) ** 2
    total = float((image[seen].astype(float) ** 2 * weight).sum())
    a, b, c = angles_from_view(sun[None], view_frame(azimuth))
    if c[0] > 0:
        total += lux**2 / SUN_SOLID_ANGLE_SR / float(position_index(a[0], b[0])) ** 2
    return float(dgp(ev, total))


def strata(
    ours: dict[str, np.ndarray],
    maps: np.ndarray,
    sun: np.ndarray,
    lux: np.ndarray,
    azimuths: np.ndarray,
) -> np.ndarray:
    """A label per view-hour, [n, d]."""
    forward = np.stack([np.sin(np.radians(azimuths)), np.cos(np.radians(azimuths))], axis=1)
    in_view = ((sun[:, :2] @ forward.T) > 0) & (lux[:, None] > 0)
    height = maps.shape[1]
    bright = (maps[:, height * 2 // 3 :] > 2000).any(
        axis=(1, 2)
    )  # below -30 degrees: sunlit floor, desks
    label = np.where(ours["ev_lx"] < 300, "low light", "other").astype(object)
    label[(ours["ev_lx"] >= 300) & bright[:, None]] = "reflections"
    label[in_view] = "sun in view"
    return label


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("maps", type=Path)
    parser.add_argument("--per-stratum", type=int, default=55)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    data = load(args.maps)
    azimuths = view_azimuths_deg(HEADING_DEG)
    views = panorama_views(*data["luminance"].shape[1:], HEADING_DEG, azimuths)
    ours = glare_directions(data["luminance"], views, data["sun"], data["disc_lx"])
    label = strata(ours, data["luminance"], data["sun"], data["disc_lx"], azimuths)
    rng = np.random.default_rng(args.seed)
    rows = compare(data, ours, label, azimuths, HEADING_DEG, rng, args.per_stratum, args.size)
    report(rows, reference_version())
    if args.out:
        with args.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


def compare(
    data: dict[str, np.ndarray],
    ours: dict[str, np.ndarray],
    label: np.ndarray,
    azimuths: np.ndarray,
    heading_deg: float,
    rng: np.random.Generator,
    per_stratum: int,
    size: int,
) -> list[dict]:
    """Ask the reference for up to `per_stratum` view-hours of each stratum."""
    rows = []
    for name in STRATA:
        cells = np.argwhere(label == name)
        for i, d in cells[rng.permutation(len(cells))[:per_stratum]]:
            sun, lux, azimuth = data["sun"][i], float(data["disc_lx"][i]), float(azimuths[d])
            altitude, around = np.degrees(np.arcsin(sun[2])), np.degrees(np.arctan2(sun[0], sun[1]))
            source = SunSource(float(altitude), float(around), lux)
            image = data["luminance"][i]
            theirs = reference_glare(
                panorama_to_fisheye(image, heading_deg, azimuth, size=size, sun=source)
            )
            rows.append(
                {
                    "stratum": name,
                    "hour": int(i),
                    "azimuth_deg": azimuth,
                    "ev": ours["ev_lx"][i, d],
                    "ev_ref": theirs.ev_lx,
                    "dgp": ours["dgp"][i, d],
                    "dgp_ref": theirs.dgp,
                    "ugr": ours["ugr"][i, d],
                    "ugr_ref": theirs.ugr,
                    "dgi": ours["dgi"][i, d],
                    "dgi_ref": theirs.dgi,
                    "sources": theirs.sources,
                    "dgp_additive": additive_dgp(
                        image, ours["ev_lx"][i, d], heading_deg, azimuth, sun, lux
                    ),
                }
            )
            print(len(rows), end="\r", file=sys.stderr)
    return rows


def report(rows: list[dict], version: str) -> None:
    """The Markdown table."""
    print(f"Reference: {version}\n")
    print(
        "| stratum | n | saturated | DGP mean abs diff | DGP largest | above .02 | without "
        "grouping | r2 |"
        " Ev mean diff % | Ev largest % | UGR | DGI |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for name in (*STRATA, "all"):
        part = [row for row in rows if name in ("all", row["stratum"])]
        if not part:
            continue
        column = {
            key: np.array([row[key] for row in part], float) for key in part[0] if key != "stratum"
        }
        off = np.abs(column["dgp"] - column["dgp_ref"])
        ev = 100 * np.abs(column["ev"] / column["ev_ref"] - 1)
        r2 = np.corrcoef(column["dgp"], column["dgp_ref"])[0, 1] ** 2
        have = np.isfinite(column["ugr"]) & (column["sources"] > 0)
        other = [
            np.abs(column[k] - column[f"{k}_ref"])[have].mean() if have.any() else np.nan
            for k in ("ugr", "dgi")
        ]
        print(
            f"| {name} | {len(part)} | {(column['dgp_ref'] >= 1).sum()} | {off.mean():.4f} | "
            f"{off.max():.3f} |"
            f" {(off > 0.02).sum()} | "
            f"{np.abs(column['dgp_additive'] - column['dgp_ref']).mean():.4f} | {r2:.4f} |"
            f" {ev.mean():.2f} | {ev.max():.2f} | {other[0]:.2f} | {other[1]:.2f} |"
        )


if __name__ == "__main__":
    main()
