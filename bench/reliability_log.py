"""A million rows of irradiance: time, memory, and recovery of a log that was cut anywhere.

    python bench/reliability_log.py --work DIR [--rows 1000000]

Prints the tables of docs/validation.md.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from fieldlum.core.records import Exposure, IrradianceSample, Site, SiteFile, Slot
from fieldlum.pair import irradiance
from fieldlum.session import (
    DayFiles,
    Journal,
    Session,
    create_session,
    day_files,
    read_day,
    read_journal,
)
from fieldlum.sky import sun

START = datetime(2027, 3, 5, tzinfo=UTC)


def memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def sample(i: int) -> IrradianceSample:
    ghi = 300.0 + (i * 7919 % 4000) / 10.0
    return IrradianceSample(
        START + timedelta(seconds=5 * i),
        ghi_wm2=ghi,
        dhi_wm2=0.3 * ghi,
        raw=f"S {ghi:.1f}, {0.3 * ghi:.1f},1",
    )


def write(session: Session, rows: int) -> tuple[float, float]:
    """Seconds per row, and how much memory grew between the first tenth and the end. [MB]"""
    log = DayFiles(session)
    begun, early = time.perf_counter(), 0.0
    for i in range(rows):
        log.append(sample(i))
        if i == rows // 10:
            early = memory_mb()
    log.close()
    return (time.perf_counter() - begun) / rows, memory_mb() - early


def cut_everywhere(session: Session) -> tuple[int, int]:
    """Cut the last day file at every byte of its last two lines; (cuts, cuts after which a row
    was lost or wrong).
    """
    path = day_files(session)[-1]
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    samples = read_day(path)[0]
    head = len(whole) - len(lines[-1]) - len(lines[-2])
    bad = 0
    for cut in range(head, len(whole) + 1):
        path.write_bytes(whole[:cut])
        log = DayFiles(session)
        last = samples[-1].t_utc + timedelta(seconds=1)
        log.append(IrradianceSample(last, ghi_wm2=1.0))
        log.close()
        kept, broken = read_day(path)
        whole_lines = whole[:cut].count(b"\n") - 1
        bad += broken != 0 or kept[:-1] != samples[:whole_lines] or kept[-1].ghi_wm2 != 1.0
    path.write_bytes(whole)
    for torn in session.irradiance.glob("*.torn"):
        torn.unlink()
    return len(whole) + 1 - head, bad


def cut_journal(session: Session) -> tuple[int, int]:
    journal = Journal(session)
    for i in range(20):
        journal.append(
            "frame", START, slot="20270305T000000Z", frame={"file": f"{i:02d}_0.25s.dng"}
        )
    journal.close()
    whole = session.journal.read_bytes()
    lines = whole.splitlines(keepends=True)
    head = len(whole) - len(lines[-1]) - len(lines[-2])
    bad = 0
    for cut in range(head, len(whole) + 1):
        session.journal.write_bytes(whole[:cut])
        journal = Journal(session)
        journal.append("close", START)
        journal.close()
        events = read_journal(session)
        kept = whole[:cut].count(b"\n")
        bad += [e.get("index") for e in events] != [*range(kept), None]
    return len(whole) + 1 - head, bad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--rows", type=int, default=1_000_000)
    asked = parser.parse_args()
    folder = asked.work / "log"
    shutil.rmtree(folder, ignore_errors=True)
    site = SiteFile(Site("log", 47.6, -122.3, "America/Los_Angeles"))
    session = create_session(folder, site, [Slot(START, 0.0, 0.0, (Exposure(1.0, 5.6),))], {})
    begun = memory_mb()
    per_row, grown = write(session, asked.rows)
    print("| step | figure |\n|---|---|")
    print(f"| rows written, each flushed | {asked.rows}, {1e3 * per_row:.3f} ms a row |")
    print(
        f"| memory before, growth over the last 90 % of the rows | {begun:.0f} MB, {grown:.1f} MB |"
    )
    rows = sum(len(read_day(p)[0]) for p in day_files(session))
    print(f"| rows read back | {rows} |")
    cuts, bad = cut_everywhere(session)
    print(
        f"| day file cut at every byte of its last two lines | {cuts} cuts, {bad} lost or harmed "
        f"a row |"
    )
    cuts, bad = cut_journal(session)
    print(
        f"| journal cut at every byte of its last two lines | {cuts} cuts, {bad} lost or harmed "
        f"an event |"
    )
    before = memory_mb()
    sun.position([START], site.site)  # pandas and pvlib themselves
    sun.extraterrestrial_wm2([START])
    libraries = memory_mb()
    tick = time.perf_counter()
    told = irradiance.run(session)
    seconds = time.perf_counter() - tick
    peak = (
        f"peak {memory_mb():.0f} MB, of it {libraries:.0f} MB before its first row "
        f"({before:.0f} MB without pandas)"
    )
    print(f"| quality control of all rows | {told.rows} rows, {seconds:.0f} s, {peak} |")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
