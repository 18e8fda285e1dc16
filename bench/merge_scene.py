"""Merged maps of simulated sessions against the scene that was photographed: is the truth within 2
u, edges included?

    python bench/merge_scene.py SESSION... [--every 9]

SESSION: one with truth/ and raw brackets (`fieldlum demo`, or `simulate` and `capture --camera
sim:office`). Every Nth bracket is merged again at the truth's size. A pixel is at an edge
where the budget's part for edges is over a fifth of a percent of its luminance.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldlum.core.records import Flag
from fieldlum.merge import MergeOptions, merge_shots
from fieldlum.merge.project import u_of_edges
from fieldlum.merge.shots import shots_of_slot
from fieldlum.optics.images import read_panorama
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.session import open_session

EDGE = 2e-3


@dataclass(frozen=True)
class Pixels:
    """Unflagged pixels [n]: error over the truth, u over the truth, and the part of u that is
    for edges.
    """

    error: np.ndarray
    u: np.ndarray
    edges: np.ndarray


def pixels_of(root: Path, every: int) -> tuple[str, Pixels]:
    session = open_session(root)
    profile = load_camera_profile(session.site_file().camera.profile or "sim-dual-fisheye")
    found = []
    for truth_path in sorted(session.truth.glob("*.exr"))[3::every]:
        folder, truth = session.raw / truth_path.stem, read_panorama(truth_path)
        if not folder.is_dir():
            continue
        options = MergeOptions(height=len(truth.luminance_cdm2))
        result = merge_shots(shots_of_slot(folder), profile, options, heading_deg=truth.heading_deg)
        map_, flags = result.panorama, result.panorama.flags
        assert flags is not None and map_.u_cdm2 is not None
        light = map_.luminance_cdm2.astype(float)
        edges = u_of_edges(
            light, (flags & Flag.OUTSIDE_LENS) == 0, options.target(profile), profile
        )
        good = (flags == 0) & (truth.luminance_cdm2 > 0)
        known = truth.luminance_cdm2[good]
        found.append(
            ((light[good] - known) / known, map_.u_cdm2[good] / known, edges[good] / known)
        )
    return profile.camera.name, Pixels(*(np.concatenate(part) for part in zip(*found, strict=True)))


def row(name: str, part: str, p: Pixels, at: np.ndarray) -> str:
    error, u, edges = np.abs(p.error[at]), p.u[at], p.edges[at]
    without = np.sqrt(np.maximum(u**2 - edges**2, 0.0))
    shares = [100 * float(np.mean(error <= 2 * v)) for v in (u, without)]
    middle = [100 * float(np.median(v)) for v in (error, u)]
    figures = (
        f"{100 * at.mean():.0f} % | {shares[0]:.1f} | {shares[1]:.1f} | {middle[0]:.2f} | "
        f"{middle[1]:.2f}"
    )
    return f"| {name} | {part} | {figures} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sessions", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=9)
    options = parser.parse_args()
    print(
        "| camera | pixels | share | within 2 u % | without the part for edges % | median error % "
        "| median u % |"
    )
    print("|---|---|---|---|---|---|---|")
    for root in options.sessions:
        name, p = pixels_of(root, options.every)
        beside = p.edges > EDGE
        for part, at in (
            ("all", np.ones(len(beside), bool)),
            ("at edges", beside),
            ("elsewhere", ~beside),
        ):
            print(row(name, part, p, at), flush=True)


if __name__ == "__main__":
    main()
