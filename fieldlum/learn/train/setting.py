"""Report where the captures contradict the stated setting, and lower the model's trust there.

A clock that differs between days is corrected in the captures. The user must correct everything
else: north, room and heading in SITE.toml, a constant error of the clock by `fieldlum import
--utc-offset`.
"""

from __future__ import annotations

from typing import cast

from fieldlum.core.records import Progress, SiteFile, quiet
from fieldlum.learn.models import Fitted, Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.transport.clock_by_day import clock_by_day, with_clock
from fieldlum.learn.transport.model import Transport
from fieldlum.learn.transport.room_errors import RoomError
from fieldlum.learn.transport.setting_scan import Setting, SettingFinding, setting_scan


def scan(data: Dataset, patch: Patch, progress: Progress = quiet) -> Setting | None:
    """Test north, clock, camera and room against the sun patches in the captures.

    Return None if patches are not used (patch "none", or `data` has none), or if under three
    captures show them.
    """
    if patch == "none" or data.patch_cdm2 is None:
        return None
    return setting_scan(data, progress)


def with_right_clock(
    data: Dataset, setting: Setting | None, progress: Progress = quiet
) -> tuple[Dataset, list[str]]:
    """Return the captures at corrected times, and a warning, if the clock differs between days.

    Otherwise return the captures unchanged, and an empty list. setting: result of `scan`; with None
    or a setting that the captures contradict, nothing is corrected, because a wrong north moves sun
    patches by another number of minutes on each day.
    """
    if setting is None or setting.slip_deg > 0.0:
        return data, []
    clock = clock_by_day(data, progress)
    if clock is None:
        return data, []
    days = ", ".join(
        f"{day} {minutes:+.1f} min"
        for day, minutes in zip(clock.days, -clock.late_min, strict=True)
    )
    warning = (
        f"WARNING: the clock of the pictures differs between days. Sun patches and held-out days "
        f"agree best after these corrections of the stated times: {days}. This training uses the "
        "corrections; set "
        f"the camera's clock on every day of captures"
    )
    return with_clock(data, clock), [warning]


def settle(fitted: Fitted, data: Dataset, setting: Setting | None) -> tuple[Fitted, list[str]]:
    """Return the model with a larger uncertainty near sun patches, and warnings.

    Both apply only if the captures contradict the computed sun patches; the uncertainty is that of
    patches displaced as far as the captures show, for a transport model only. setting: result of
    `scan`. Nothing is corrected: a wrong north must be corrected in SITE.toml, which all stages
    read.
    """
    if setting is None or setting.slip_deg == 0.0:
        return fitted, []
    if isinstance(fitted, Transport):
        fitted = cast("Fitted", fitted.with_displaced_patches(setting.slip_deg))
    return fitted, warnings_of(setting, data.setup, 360.0 / data.shape[1])


def warnings_of(setting: Setting, setup: SiteFile, pixel_deg: float) -> list[str]:
    """Return lines that warn of a wrong setting: what is wrong, then a remedy for each cause.

    setting: result of `scan`; pixel_deg: width of a pixel of the maps. The list is empty if no
    cause is certain. It has one line, without a remedy in SITE.toml, if a wrong measure in [room]
    explains nearly as much.
    """
    if setting.room is not None:
        return [_measure_warning(setting, setting.room)]
    cause = setting.wrong
    if cause is None:
        return []
    share = cause.gain / cause.stated
    text = (
        f"WARNING: captured sun patches are displaced from the computed ones ({setting.hours} "
        f"hours): {_words(cause)}, which "
    )
    text += f"explains {share:.0%} of the misfit"
    others = [f"{_words(f)} ({f.gain / cause.gain:.0%} of that)" for f in setting.alike]
    text += f"; nearly as likely: {', '.join(others)}" if others else ""
    lines = [
        f"{text}. Until this is fixed, the transport model has a larger uncertainty in hours that "
        f"depend on sun patches"
    ]
    lines += [f"to fix {f.cause}: {_remedy(f, setup, pixel_deg)}" for f in (cause, *setting.alike)]
    return lines


def _measure_warning(setting: Setting, measure: RoomError) -> str:
    """Return a warning if a wrong measure of the room explains as much as north or clock."""
    first = setting.findings[0]
    return (
        f"WARNING: captured sun patches are not where [room] puts them ({setting.hours} hours): "
        f"changing {measure.name} by {measure.amount_m:+.2f} m would explain "
        f"{measure.gain / first.stated:.0%} of the misfit, changing {first.cause} "
        f"{first.gain / first.stated:.0%}. The captures do not show which is wrong: measure the "
        f"camera's place and the windows again before changing anything else. Until then, the "
        f"transport model has a larger uncertainty in hours that depend on sun patches"
    )


def _words(finding: SettingFinding) -> str:
    a, e = finding.amount, finding.error
    texts = {
        "north": lambda: f"north is wrong by {a[0]:+.1f} +- {e[0]:.1f} degrees",
        "clock": lambda: f"the clock is wrong by {a[0]:+.1f} +- {e[0]:.1f} minutes",
        "north and clock": lambda: (
            f"north is wrong by {a[0]:+.1f} +- {e[0]:.1f} degrees and the clock by {a[1]:+.1f} +- "
            f"{e[1]:.1f} minutes"
        ),
        "wall": lambda: (
            f"the room, not the camera, is turned clockwise by {a[0]:+.1f} +- {e[0]:.1f} degrees"
        ),
        "camera": lambda: (
            f"the camera was displaced: captured sun patches are {a[0]:+.1f} +- {e[0]:.1f} pixels "
            f"to the right of the computed ones and {a[1]:+.1f} +- {e[1]:.1f} pixels below them "
            f"(negative: left, above)"
        ),
    }
    return texts[finding.cause]()


def _remedy(finding: SettingFinding, setup: SiteFile, pixel_deg: float) -> str:
    """Return what to write into SITE.toml, or what else to do."""
    a = finding.amount
    room = setup.room
    wall = (
        f"[room] wall_azimuth_deg = {(room.wall_azimuth_deg + a[0]) % 360.0:.1f}"
        if room is not None
        else ""
    )
    camera = f"[camera] heading_deg = {(setup.camera.heading_deg + a[0]) % 360.0:.1f}"
    again = "then merge, pair and train again"
    minutes = a[-1]
    clock = (
        f"the recorded times of the pictures are {abs(minutes):.1f} min too "
        f"{'late' if minutes > 0 else 'early'}: correct the clock that recorded them (the "
        "computer's for fieldlum capture, else the camera's), or import the card again with "
        f"--utc-offset {'increased' if minutes > 0 else 'decreased'} by {abs(minutes):.1f} min"
    )
    if finding.cause == "north":
        return f"check the compass; in SITE.toml {wall} and {camera}, {again}"
    if finding.cause == "clock":
        return f"{clock}, {again}"
    if finding.cause == "north and clock":
        return f"in SITE.toml {wall} and {camera}; {clock}, {again}"
    if finding.cause == "wall":
        return f"check where the window wall faces; in SITE.toml {wall}, then pair and train again"
    heading = (setup.camera.heading_deg - a[0] * pixel_deg) % 360.0
    return (
        "check the camera's place and level, and the window's place in [room]; if only its heading "
        f"is wrong, in SITE.toml [camera] heading_deg = {heading:.1f}, {again}"
    )
