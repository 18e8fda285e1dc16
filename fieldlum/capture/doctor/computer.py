"""Check this computer: clock, disk, writing, sleep."""

from __future__ import annotations

import os
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.capture.doctor.findings import Finding, Verdict
from fieldlum.session import Session
from fieldlum.session.ledger import slots_ahead

DISK_MARGIN = 1.3  # free space over planned size; chosen, not measured
# seconds for 1 MB; a slower disk delays the frames of a bracket. Chosen, not measured.
SLOW_FSYNC_S = 0.5
SYNCED_FOLDERS = ("dropbox", "onedrive", "google drive", "googledrive", "icloud", "nextcloud")


def check_clock(synchronised: bool | None) -> Finding:
    """Return a finding on this computer's clock: a warning unless it is synchronised.

    synchronised: None if unknown, which is a warning too.
    """
    now = f"this computer has {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    if synchronised is None:
        text = (
            f"{now}, and it is unknown whether its clock is synchronised: compare it with "
            "a time server"
        )
        return Finding("clock", "warn", text)
    if not synchronised:
        text = (
            f"{now}, and its clock is not synchronised: switch network time on, or set "
            "the clock by hand today"
        )
        return Finding("clock", "warn", text)
    return Finding("clock", "ok", f"{now}, synchronised by a time server")


def check_disk(session: Session, now_utc: datetime, free_bytes: int) -> Finding:
    """Return a finding on the disk: it fails without space for all future slots and 30 % more.

    free_bytes: free space. A slot needs what the plan states, or more if one of the last five
    brackets was larger.
    """
    ahead = slots_ahead(session, now_utc)
    planned = 1e6 * float(session.table().get("plan", {}).get("megabytes_per_slot", 0.0))
    wanted = len(ahead) * max(planned, _largest_bracket_bytes(session)) * DISK_MARGIN
    need = (
        f"{wanted / 1e9:.1f} GB for {len(ahead)} slots, with {100 * (DISK_MARGIN - 1):.0f} % in "
        "reserve"
    )
    if free_bytes < wanted:
        remedy = "delete files or use a larger disk"
        return Finding("disk", "fail", f"{free_bytes / 1e9:.1f} GB free; needed: {need}; {remedy}")
    return Finding("disk", "ok", f"{free_bytes / 1e9:.1f} GB free, enough: {need}")


def _largest_bracket_bytes(session: Session) -> int:
    """Return the size of the largest of the last five brackets.

    The files of a camera may differ much from the profile's estimate.
    """
    taken = [
        folder
        for folder in session.captured_folders()
        if session.capture_file(folder.name).is_file()
    ]
    return max(
        (sum(file.stat().st_size for file in folder.glob("[!.]*")) for folder in taken[-5:]),
        default=0,
    )


def check_writing(folder: Path) -> list[Finding]:
    """Write 1 MB into the folder, flush, rename and read it back; return findings on this.

    An error, or other bytes than those written, is a failure. A flush of over 0.5 s, or a folder
    that a cloud service synchronises, is a warning.
    """
    path = folder / f".doctor.{os.getpid()}.tmp"
    payload = os.urandom(1 << 20)
    start = time.perf_counter()
    try:
        with path.open("wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        took = time.perf_counter() - start
        renamed = path.replace(path.with_suffix(".renamed"))
        same = renamed.read_bytes() == payload
    except OSError as error:
        text = f"{folder}: {error.strerror}: free space, or use a folder that can be written to"
        return [Finding("writing", "fail", text)]
    finally:
        path.unlink(missing_ok=True)
        path.with_suffix(".renamed").unlink(missing_ok=True)
    if not same:
        text = f"{folder}: the bytes read differ from those written: use another disk"
        return [Finding("writing", "fail", text)]
    verdict: Verdict = "warn" if took > SLOW_FSYNC_S else "ok"
    text = f"1 MB written and flushed in {took * 1000:.0f} ms"
    text += ", which delays the frames of a bracket: use a faster disk" if verdict == "warn" else ""
    findings = [Finding("writing", verdict, text)]
    if any(name in str(folder.resolve()).lower() for name in SYNCED_FOLDERS):
        text = (
            "the folder's path has the name of a cloud service, which can lock files that it "
            "synchronises: if it does, move the session to a local folder"
        )
        findings.append(Finding("writing", "warn", text))
    return findings


def has_lid() -> bool:
    """Return whether this computer has a lid, by Linux's ACPI; False on other systems."""
    return any(Path("/proc/acpi/button/lid").glob("*"))


def check_sleep(locks: str, *, lid: bool = False) -> Finding:
    """Return a finding on whether a capture can keep this computer awake, a warning if it cannot.

    locks: names of the locks that `capture` is granted, joined by colons; lid: whether there is a
    lid. By logind's default a closed lid overrides a lock on sleep; only a lock on
    handle-lid-switch prevents this.
    """
    command = {
        "linux": "systemd-inhibit --what=sleep:idle:handle-lid-switch fieldlum capture ...",
        "darwin": "caffeinate -dims fieldlum capture ...",
    }.get(sys.platform)
    how = f"start the capture with: {command}" if command else "switch sleep off in the settings"
    if "sleep" not in locks.split(":"):
        text = f"capture is granted no lock that keeps this computer awake: {how}"
        return Finding("sleep", "warn", text)
    text = "prevented by capture itself while it runs"
    if lid and "handle-lid-switch" not in locks:
        text += f", but a closed lid would still send this computer to sleep: {how}"
        return Finding("sleep", "warn", text)
    return Finding("sleep", "ok", text)
