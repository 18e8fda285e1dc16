"""What is said about a merged bracket: its figures, and one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.merge.shift import Moved
from fieldlum.projection.resample import Target
from fieldlum.records import Flag, utc_text
from fieldlum.session import exposure_text
from fieldlum.session.files.sidecar import exposure_keys

if TYPE_CHECKING:
    from fieldlum.merge.bracket import SensorMerge

RESIDUAL_WARN_PERCENT = 3.0
SHIFT_WARN_PX = 1.0  # beyond three standard errors
OFF_WARN, OFF_SIGMA = (
    0.02,
    3.0,
)  # exposures further off than both, relative and in u of the prior, are told
BLACK_WARN_DN = 1.0


@dataclass(frozen=True, slots=True)
class Offsets:
    """How far each frame's exposure was found off what the profile says (logarithm), and the u
    of that beforehand.
    """

    found: NDArray[np.float64]
    u_prior: NDArray[np.float64]

    @property
    def span_percent(self) -> float:
        return float(100 * np.ptp(self.found))

    @property
    def beyond_prior(self) -> bool:
        return bool((np.abs(self.found) > np.maximum(OFF_WARN, OFF_SIGMA * self.u_prior)).any())

    @property
    def text(self) -> str:
        low, high = 100 * np.expm1(self.found.min()), 100 * np.expm1(self.found.max())
        return f"{low:+.1f} to {high:+.1f}"


def quality_of(parts: Sequence[SensorMerge], flags: np.ndarray, target: Target) -> dict[str, Any]:
    """Figures of one bracket; shares are of the solid angle seen. [%]"""
    solid = target.solid_angles()
    seen = solid * ((flags & Flag.OUTSIDE_LENS) == 0)

    def share(flag: Flag) -> float:
        return float(100 * (seen * ((flags & flag) > 0)).sum() / max(seen.sum(), 1e-12))

    frames = [
        {
            "file": shot.path.name,
            "heading_deg": shot.heading_deg,
            "t_utc": utc_text(shot.t_utc) if shot.t_utc else "",
            "exposure": exposure_text(shot.exposure),
            **exposure_keys(shot.exposure),
            "correction": round(float(c), 6),
            "u_percent": round(float(100 * u), 4),
            **({"dropped_percent": round(100 * part.dropped[i], 4)} if part.dropped else {}),
        }
        for part in parts
        for i, (shot, c, u) in enumerate(
            zip(part.shots, part.fit.correction, part.fit.u_log, strict=True)
        )
    ]
    left = [n for part in parts for n in part.neighbours]
    moved = [
        {
            "long": part.shots[m.long].path.name,
            "short": part.shots[m.short].path.name,
            **_rounded(m),
        }
        for part in parts
        for m in part.moved
    ]
    most = max(moved, key=lambda m: m["sure_px"], default=None)
    return {
        "frames": frames,
        "neighbours": [asdict(n) for n in left],
        "residual_percent": float(max(abs(n.residual_percent) for n in left)) if left else None,
        "shifts": moved,
        "shift_px": most["shift_px"] if most else None,
        "shift_u_px": most["u_px"] if most else None,
        "clipped_percent": share(Flag.CLIPPED_HIGH),
        "bloom_percent": share(Flag.BLOOM),
        "motion_percent": share(Flag.MOTION),
        "below_noise_percent": share(Flag.BELOW_NOISE),
        "outside_percent": float(100 * (1 - seen.sum() / max(solid.sum(), 1e-12))),
        "exposure_span_percent": max(p.off.span_percent for p in parts),
        "exposure_told": [p.off.text for p in parts if p.off.beyond_prior],
        "noise_over_said": max(p.noise.larger for p in parts),
        "plateau_dn": {f"{iso:g}": list(found) for iso, found in parts[0].look.plateau_dn.items()},
        "black_off_dn": max((p.look.black_off_dn for p in parts), key=abs),
        "shutter_law": asdict(parts[0].law),
        "u_ratio_percent": 100 * float(np.sqrt(np.mean([p.u_ratio**2 for p in parts]))),
    }


def _rounded(moved: Moved) -> dict[str, Any]:
    return {
        name: round(float(getattr(moved, name)), 3)
        for name in ("turn_deg", "shift_px", "u_px", "sure_px")
    }


def verdict(quality: dict[str, Any]) -> str:
    """One line: good, or what to look at."""
    said = []
    worst = quality["residual_percent"]
    if worst is None:
        said.append("no two frames overlap")
    elif worst > RESIDUAL_WARN_PERCENT:
        said.append(f"neighbouring frames disagree by {worst:.1f} %")
    said += [
        f"exposures lie {text} % from the profile's: the light changed meanwhile, or calibrate "
        f"shutter and response"
        for text in quality["exposure_told"]
    ]
    if quality["held_otherwise"]:
        said.append(quality["held_otherwise"])
    if abs(quality["black_off_dn"]) > BLACK_WARN_DN:
        said.append(
            f"the files' black level lies {quality['black_off_dn']:+.1f} DN from the profile's"
        )
    if quality["noise_over_said"] > 1.0:
        said.append(
            f"noise is {quality['noise_over_said']:.1f} times what the profile's gain and read "
            f"noise say"
        )
    said += [
        f"the camera turned by {m['turn_deg']:.2f} deg ({m['shift_px']:.1f} px) between "
        f"{m['long']} and {m['short']}"
        for m in quality["shifts"]
        if m["sure_px"] > SHIFT_WARN_PX
    ]
    if quality["clipped_percent"] > 0:
        said.append(f"clipped in every frame: {quality['clipped_percent']:.2g} % of the view")
    if quality["motion_percent"] > 2.0:
        said.append(f"motion in {quality['motion_percent']:.1f} % of the view")
    if quality["below_noise_percent"] > 5.0:
        said.append(f"below noise: {quality['below_noise_percent']:.1f} %")
    return "; ".join(said) or f"good: frames agree within {worst:.2f} %"
