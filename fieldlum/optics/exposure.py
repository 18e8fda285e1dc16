"""Compute with exposures: linear light for a luminance, true shutter times, laws of a shutter.

L = k 87 N^2 / (t S) z: luminance [cd/m2], scale k, f-number N, true time t [s], ISO S, and linear
light z, which is 1 at full scale.

A mechanical shutter runs in thirds or halves of a stop, and its labels are rounded: 1/60 is 1/64 s.
An electronic shutter exposes for its labelled time: 1/60 is 0.016667 s (measured on a phone's
bracket, MercuryYen/HDR-Imaging data/101; Ricoh states the same for the Theta). The two differ by up
to 6.7 %.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats
from fieldlum.core.records import Exposure

# The empirical constant of hdrgen (Ward, panlib). A wrong value scales all luminances without a
# scale calibration.
STONITS = 87.0
# Settings of cameras are a third of a stop apart: two values within the half of it are the same
# setting, rounded differently.
SAME_SETTING_EV = 1 / 6


def same_exposure(a: Exposure, b: Exposure) -> bool:
    """Return whether shutter, aperture and ISO each differ by at most 1/6 EV.

    Filters are not compared, because cameras do not record them.
    """
    ratios = (a.shutter_s / b.shutter_s, (a.f_number / b.f_number) ** 2, a.iso / b.iso)
    return all(abs(math.log2(ratio)) <= SAME_SETTING_EV for ratio in ratios)


def z_per_cdm2(shutter_s: float, f_number: float, iso: float, k: float = 1.0) -> float:
    """Return the linear signal z (1 at full scale) that 1 cd/m2 causes, by L = k 87 N^2 / (t S) z.

    shutter_s: true time t; f_number: N; iso: S; k: factor of the scale calibration. 87 is hdrgen's
    constant (`STONITS`).
    """
    return shutter_s * iso / (STONITS * f_number**2 * k)


def prior_u_log(shutter_s: ArrayLike) -> Floats:
    """Return the relative standard uncertainty [n] of shutter times [n] in s that are not measured.

    0.003 from 1/1000 s on, 0.03 for shorter times, at which mechanical shutters are less accurate:
    errors of up to 3.9 % were measured (docs/validation.md).
    """
    return np.where(np.asarray(shutter_s) < 1 / 1000, 0.03, 0.003)


# ----------------------------------------------------------------------------------------------
# the law of a shutter


THIRD_STOPS, HALF_STOPS, EXACT, AUTO = "third-stops", "half-stops", "exact", "auto"
LAWS = (THIRD_STOPS, HALF_STOPS, EXACT)
# Settings in a stop, and how far a label may be from the nearest one, as a share: a time further
# away is used unchanged. Labels are rounded by up to 6.3 % (13 s) in thirds of a stop, and by
# 11.6 % (1/20 s is 2^-4.5 s) in halves. Sources: linearhdr (Wasilewski), hdrmerge (Jakob).
_GRIDS = {THIRD_STOPS: ((3,), 0.07), HALF_STOPS: ((2,), 0.12), AUTO: ((3, 2), 0.07)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRatio:
    """The measured exposure ratio of two frames.

    long, short: indices of the frames, from 0. log_ratio: ln(true / assumed exposure) of frame
    `short` minus the same of frame `long`; u_log: standard uncertainty of log_ratio; pixels: number
    of pixels used.
    """

    long: int
    short: int
    log_ratio: float
    u_log: float
    pixels: int


@dataclass(frozen=True, slots=True)
class ShutterLaw:
    """The law of a bracket's shutter times.

    law: "third-stops", "half-stops" or "exact" (`true_times_s`); decided_by: "profile", "labels" or
    "frames" ("": not stated); misfit_percent: for each law, the rms difference of the measured
    exposure ratios from it, in %; empty without measured ratios.
    """

    law: str
    decided_by: str = ""
    misfit_percent: dict[str, float] = field(default_factory=dict)


def true_times_s(nominal_s: ArrayLike, law: str = AUTO) -> Floats:
    """Return the true times [...] in s of nominal times [...] in s.

    law: "exact" changes nothing; "third-stops" and "half-stops" round to powers of 2^(1/3) and
    2^(1/2) s, but a time over 7 % or 12 % away from them is returned unchanged; "auto" rounds to
    the nearer of the two, unless that is over 7 % away.
    """
    nominal = np.asarray(nominal_s, np.float64)
    if law == EXACT:
        return nominal.copy()
    settings_per_stop, reach = _GRIDS[law]
    stops = np.log2(nominal)
    settings = np.stack([np.round(stops * n) / n for n in settings_per_stop])  # [grids, ...]
    nearest = np.abs(settings - stops).argmin(axis=0)[None]
    rounded = 2.0 ** np.take_along_axis(settings, nearest, axis=0)[0]
    return np.where(np.abs(rounded / nominal - 1.0) <= reach, rounded, nominal)


def law_of_labels(nominal_s: ArrayLike, model: str = "") -> ShutterLaw:
    """Return the shutter law, half or third stops, that fits the nominal times [n] in s best.

    If both fit equally, it is third stops. model: name of the camera; if it contains "theta" the
    law is "exact" (theta-web-api-v2.1, shutterSpeed).
    """
    if "theta" in model.casefold():
        return ShutterLaw(EXACT, "labels")
    stops = np.log2(np.asarray(nominal_s, np.float64))
    # sums of squared distances from the nearest settings
    thirds, halves = (float(((np.round(stops * n) / n - stops) ** 2).sum()) for n in (3, 2))
    return ShutterLaw(HALF_STOPS if halves < 0.999 * thirds else THIRD_STOPS, "labels")


def stated_law(nominal_s: ArrayLike, law: str, model: str) -> ShutterLaw:
    """Return the shutter law that a camera profile states; for "auto" that of the nominal times.

    nominal_s: shutter times of a bracket's frames by EXIF [n], s; law: of the profile, one of
    `LAWS` or "auto"; model: of its camera. The result's `decided_by` is "profile" or "labels".
    """
    return law_of_labels(nominal_s, model) if law == AUTO else ShutterLaw(law, "profile")


def law_of_frames(
    times_s: Mapping[str, Floats], of_labels: ShutterLaw, pairs: Sequence[PairRatio]
) -> ShutterLaw:
    """Return the law that measured ratios support; the law of `of_labels` if they cannot decide.

    times_s: for each law, the true times [frames] in s; pairs: ratios measured relative to the
    times under the law of `of_labels`; without pairs `of_labels` is returned. Only under the
    correct law do equal steps of the shutter change the signal equally. A wrong response, or
    changing light, stretches all steps by one factor, which is estimated for each law. The frames
    decide if the ratios scatter at least twice as much about every other law whose steps differ by
    over 2 %.
    """
    if not pairs:
        return of_labels
    long, short = np.array([(pair.long, pair.short) for pair in pairs]).T
    measured = np.array([pair.log_ratio for pair in pairs])
    assumed = np.log(times_s[of_labels.law])
    step = {law: np.log(times_s[law][short] / times_s[law][long]) for law in LAWS}  # [pairs] each
    residual = {law: measured - step[law] + (assumed[short] - assumed[long]) for law in LAWS}
    stretch = {law: residual[law] @ step[law] / max(step[law] @ step[law], 1e-12) for law in LAWS}
    scatter = {law: float(np.std(residual[law] - step[law] * stretch[law])) for law in LAWS}
    best = min(LAWS, key=lambda law: (scatter[law], law != of_labels.law))
    others = [law for law in LAWS if np.abs(step[law] - step[best]).max() > 0.02]
    decided = bool(others) and all(scatter[law] > 2.0 * scatter[best] for law in others)
    misfit = {law: round(100.0 * float(np.sqrt(np.mean(residual[law] ** 2))), 2) for law in LAWS}
    if not decided:
        return ShutterLaw(of_labels.law, of_labels.decided_by, misfit)
    # among laws that agree for these frames, the law of the labels has precedence
    law = best if of_labels.law in others else of_labels.law
    return ShutterLaw(law, "frames", misfit)
