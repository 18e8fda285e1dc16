"""Test north, clock, camera and room against the captures, by the places of sun patches.

Sun patches have sharp edges. If computed patches are displaced from the captured ones, a sunlit
pixel is predicted dark and a dark pixel sunlit, in every capture. Held-out days then have large
errors, but do not show the cause. Here patches are computed for other settings, to find the setting
under which they match the captured ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from fieldlum.core.arrays import Array
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.transport.misalignment import (
    MOST_SHIFT_PX,
    MOST_TURN_DEG,
    Evidence,
    evidence_of,
)
from fieldlum.learn.transport.room_errors import RoomError, room_error

Amount = tuple[float, ...]

TURNS_DEG = (MOST_TURN_DEG, 1.0, 0.125)  # reach, coarse step and fine step; chosen
MINUTES, SHIFTS_PX = (20.0, 4.0, 0.5), (float(MOST_SHIFT_PX), 1.0, 0.25)  # as TURNS_DEG
RESAMPLES = 200  # number of bootstrap samples; chosen
MOST_MOVES = 6  # most moves of the joint search; chosen, limits the time
SURE = 3.0  # least ratio of an amount to its standard error; chosen
# Share of the misfit that another setting must explain, on most of the days. Chosen.
LEAST_GAIN = 0.005
# another cause that explains at least this share of the best cause's gain is reported too; chosen
ALIKE = 0.8
# Blur in px: patches moved by fractions of a pixel are blurred, which would favour integer amounts.
# Chosen.
BLUR_PX = 0.25


@dataclass(frozen=True, slots=True)
class SettingFinding:
    """How well one cause (a wrong north, clock, wall or camera) explains displaced sun patches.

    cause: a name listed in `Setting`; amount: how wrong the setting would be, in the unit and sign
    listed there, one value or two; error: standard error of each amount over days; misfit: share of
    wrong pixels near sun patches, 0 to 1, with this amount corrected; stated: the same with the
    stated setting; sigmas: `stated` minus `misfit`, in standard errors over days.
    """

    cause: str
    amount: Amount
    error: Amount
    misfit: float
    stated: float
    sigmas: float

    @property
    def gain(self) -> float:
        """Share of wrong pixels that this cause explains: `stated` minus `misfit`."""
        return self.stated - self.misfit

    @property
    def sure(self) -> bool:
        """Whether the cause is certain: an amount is over three standard errors, and gain is large.

        `gain` must exceed 0.5 % of `stated`, and its own standard error over days.
        """
        far = max(abs(a) / e for a, e in zip(self.amount, self.error, strict=True))
        return far > SURE and self.gain > LEAST_GAIN * self.stated and self.sigmas > 1.0


@dataclass(frozen=True, slots=True)
class Setting:
    """Which wrong setting would explain that sun patches are not where they are computed.

    findings: one for each cause, the cause that explains most first.

    Causes are "north" (deg: room and camera are turned further clockwise than stated), "clock"
    (min: the stated times are later than the true ones), "north and clock" (both), "wall" (deg:
    only the room is turned further clockwise), "camera" (px: patches must move right and down).
    Their misfit is the share of the pixels near sun patches that are wrong, over `hours` sunny
    hours. alike: other causes that explain over 80 % of what the first explains. slip_deg:
    displacement of the computed patches from the captured ones as seen from the camera; 0 if no
    cause is certain, which means that the captures do not contradict the setting. room: a wrong
    measure in [room] that explains over 80 % of what the first cause explains, None if none does.
    """

    findings: tuple[SettingFinding, ...]
    alike: tuple[SettingFinding, ...]
    slip_deg: float
    hours: int

    room: RoomError | None = None

    @property
    def wrong(self) -> SettingFinding | None:
        """The finding of the cause that explains most.

        None if no cause is certain, or if a wrong measure in [room] explains nearly as much.
        """
        return self.findings[0] if self.slip_deg > 0.0 and self.room is None else None


# ----------------------------------------------------------------------------------------------
# search


class _Curve:
    """Misfits [n] at each amount that was tried."""

    def __init__(self, misfit: Callable[..., Array]) -> None:
        self.misfit = misfit
        self.tried: dict[Amount, Array] = {}

    def at(self, *amount: float) -> Array:
        key = tuple(round(a, 6) for a in amount)
        if key not in self.tried:
            self.tried[key] = self.misfit(*key)
        return self.tried[key]

    def best(self) -> Amount:
        return min(self.tried, key=lambda key: float(self.tried[key].mean()))


def _along(curve: _Curve, reach: float, coarse: float, fine: float) -> None:
    """Search one amount: coarse steps over the full reach, then fine steps around the best."""
    for amount in np.arange(-reach, reach + coarse / 2, coarse):
        curve.at(float(amount))
    middle = curve.best()[0]
    for amount in np.arange(-coarse, coarse + fine / 2, fine):
        curve.at(middle + float(amount))


def _across(curve: _Curve, reach: float, coarse: float, fine: float) -> None:
    """Search two amounts in the same way as `_along`."""
    steps = np.arange(-reach, reach + coarse / 2, coarse)
    for a in steps:
        for b in steps:
            curve.at(float(a), float(b))
    right, down = curve.best()
    near = np.arange(-coarse, coarse + fine / 2, fine)
    for a in near:
        curve.at(right + float(a), down)
    right = curve.best()[0]
    for b in near:
        curve.at(right, down + float(b))


def _jointly(curve: _Curve, start: Amount) -> None:
    """Search turn and clock together: from `start` to the best neighbour, in ever smaller steps."""
    at = start
    curve.at(*at)
    for halving in (4.0, 2.0, 1.0):
        for _ in range(MOST_MOVES):
            a, b = halving * TURNS_DEG[2], halving * MINUTES[2]
            for i in (-1, 0, 1):
                for j in (-1, 0, 1):
                    curve.at(at[0] + i * a, at[1] + j * b)
            if curve.best() == tuple(round(x, 6) for x in at):
                break
            at = curve.best()


def _spread(curve: _Curve, groups: NDArray) -> Amount:
    """Return the standard errors of the best amount, one for each of its components.

    Days are drawn again with replacement; each draw has its own best amount among those tried.
    """
    amounts = np.array(list(curve.tried))
    losses = np.array(list(curve.tried.values()))
    unique, which = np.unique(groups, return_inverse=True)
    sums = np.stack([losses[:, which == g].sum(axis=1) for g in range(len(unique))], axis=1)
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(unique), np.full(len(unique), 1.0 / len(unique)), RESAMPLES)
    best = amounts[np.argmin(sums @ drawn.T, axis=0)]
    return tuple(float(s) for s in best.std(axis=0))


def _sigmas(gain: Array, groups: NDArray) -> float:
    """Return the mean of `gain` [n] over its standard error; groups are independent."""
    sums = np.array([gain[groups == g].sum() for g in np.unique(groups)])
    spread = float(sums.std(ddof=1)) * np.sqrt(len(sums))
    return float(sums.sum() / spread) if spread > 0.0 else 0.0


def setting_scan(data: Dataset, progress: Progress = quiet) -> Setting | None:
    """Find which wrong north, clock, wall or camera would explain displaced sun patches.

    Without a box room only "camera" is tested. Return None without sun patches, or if fewer than
    three captures show direct sun; a setting without an error gives a `Setting` with slip_deg 0.
    """
    progress(0, 100, "setting: light without patches")
    evidence = evidence_of(data)
    if evidence is None:
        return None
    makers: dict[str, Callable[..., Array]] = {"camera": evidence.given}
    if evidence.points is not None:
        makers |= {
            "north": evidence.computed,
            "clock": lambda fast_min: evidence.computed(0.0, fast_min),
            "wall": evidence.walled,
            "north and clock": evidence.computed,
        }
    curves = {cause: _Curve(_misfit(evidence, cause, make)) for cause, make in makers.items()}
    pixel_deg = 360.0 / data.shape[1]
    findings: list[SettingFinding] = []
    for k, (cause, curve) in enumerate(curves.items()):
        progress(30 + 14 * k, 100, f"setting: {cause}")
        if cause == "north and clock":
            single = max(
                (f for f in findings if f.cause in ("north", "clock")), key=lambda f: f.gain
            )
            if not single.sure:
                continue
            _jointly(
                curve,
                (single.amount[0], 0.0) if single.cause == "north" else (0.0, single.amount[0]),
            )
            steps = TURNS_DEG[2], MINUTES[2]
        elif cause == "camera":
            _across(curve, *SHIFTS_PX)
            steps = BLUR_PX, BLUR_PX
        else:
            _along(curve, *(MINUTES if cause == "clock" else TURNS_DEG))
            steps = {"clock": (MINUTES[2] / 2,), "wall": (BLUR_PX * pixel_deg,)}.get(
                cause, (TURNS_DEG[2] / 2,)
            )
        findings.append(_finding(cause, curve, evidence.groups, steps))
    findings = _ranked(findings)
    if not any(f.sure for f in findings):
        return Setting(tuple(findings), (), 0.0, len(evidence.rows))
    first = findings[0]
    slip = _slip_deg(evidence, first.cause, makers[first.cause](*first.amount))
    alike = tuple(f for f in findings[1:] if f.gain > ALIKE * first.gain)
    measure = room_error(evidence, progress)
    if measure is not None and measure.gain <= ALIKE * first.gain:
        measure = None
    return Setting(tuple(findings), alike, slip, len(evidence.rows), measure)


def _misfit(evidence: Evidence, cause: str, make: Callable[..., Array]) -> Callable[..., Array]:
    gain = evidence.gains[0 if cause == "camera" else 1]
    return lambda *amount: evidence.misfit(make(*amount), gain)


def _finding(cause: str, curve: _Curve, groups: NDArray, least_error: Amount) -> SettingFinding:
    best = curve.best()
    misfit, stated = curve.at(*best), curve.at(*(0.0,) * len(best))
    error = tuple(
        float(np.hypot(s, e)) for s, e in zip(_spread(curve, groups), least_error, strict=True)
    )
    return SettingFinding(
        cause,
        best,
        error,
        float(misfit.mean()),
        float(stated.mean()),
        _sigmas(stated - misfit, groups),
    )


def _ranked(findings: list[SettingFinding]) -> list[SettingFinding]:
    """Return the findings, those that explain most first.

    A finding of two causes must have both certain, and must explain far more than one cause.
    """
    single = [f for f in findings if f.cause != "north and clock"]
    most = max(f.gain for f in single)
    both = [
        f
        for f in findings
        if f not in single
        and ALIKE * f.gain > most
        and min(abs(a) / e for a, e in zip(f.amount, f.error, strict=True)) > SURE
    ]
    return sorted(single + both, key=lambda f: -f.gain)


def _slip_deg(evidence: Evidence, cause: str, best: Array) -> float:
    """Return the displacement between the stated and the best patches [deg].

    It is the shift across edges whose expected square equals that between the two.
    """
    camera = cause == "camera"
    assert evidence.data.patch_cdm2 is not None
    maps = evidence.data.patch_cdm2[evidence.rows] if camera else evidence.computed(full_maps=True)
    gain = evidence.gains[0 if camera else 1]
    modes = ("nearest", "nearest", "wrap")
    low, high = (
        np.asarray(near(maps, (1, 3, 3), mode=modes))  # pyright: ignore[reportArgumentType]
        for near in (minimum_filter, maximum_filter)
    )
    flat = [part.reshape(len(part), -1)[:, evidence.pixels] for part in (maps, low, high)]
    stated, darkest, brightest = (evidence.light(part, gain) for part in flat)
    change = ((evidence.light(best, gain) - stated) ** 2).sum()
    span = ((brightest - darkest) ** 2).sum()
    return float(2.0 * change / max(span, 1e-12) * 180.0 / evidence.data.shape[0])
