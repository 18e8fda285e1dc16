"""What is reported as written is on the disk: flush before rename, rename before journal.

A layer between Python and the system records every flush and rename with the file's number (inode),
so that a power cut can be judged without one.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from tiny_field import FAST, T0, Field, make_session

from fieldlum.core.files import encode_line
from fieldlum.core.records import IrradianceSample
from fieldlum.session import DayFiles, Journal, replacing

pytestmark = pytest.mark.skipif(os.name != "posix", reason="folders are not flushed elsewhere")


@dataclass
class DiskLayer:
    """Flushes as ("flush", inode, size), renames as ("rename", inode, name of the new place)."""

    events: list[tuple[str, int, Any]] = field(default_factory=list)

    def flush(self, handle: int) -> None:
        about = os.fstat(handle)
        self.events.append(("flush", about.st_ino, about.st_size))

    def renamed(self, name: str) -> int:
        """Return the place in `events` of the rename to a name; assert that it was flushed."""
        places = [i for i, event in enumerate(self.events) if event[::2] == ("rename", name)]
        assert len(places) == 1, name
        inode = self.events[places[0]][1]
        assert ("flush", inode) in [event[:2] for event in self.events[: places[0]]], name
        return places[0]

    def flushed_after(self, place: int, path: Path) -> bool:
        inode = path.stat().st_ino
        return ("flush", inode) in [event[:2] for event in self.events[place:]]


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> DiskLayer:
    layer, rename = DiskLayer(), os.replace

    def record(source: Any, target: Any) -> None:
        layer.events.append(("rename", Path(source).stat().st_ino, Path(target).name))
        rename(source, target)

    monkeypatch.setattr(os, "fsync", layer.flush)
    monkeypatch.setattr(os, "fdatasync", layer.flush, raising=False)
    monkeypatch.setattr(os, "replace", record)
    return layer


@pytest.mark.contract
def test_a_replaced_file_is_flushed_then_renamed_then_its_folder_is_flushed(
    tmp_path: Path, disk: DiskLayer
) -> None:
    with replacing(tmp_path / "a.json", "w") as file:
        file.write("content")
    place = disk.renamed("a.json")
    inode = (tmp_path / "a.json").stat().st_ino
    assert ("flush", inode, 7) in disk.events[:place], "with its whole content"
    assert disk.flushed_after(place, tmp_path)


@pytest.mark.contract
@pytest.mark.parametrize("flush", [True, False])
def test_a_line_of_journal_and_log_is_on_the_disk_when_append_returns(
    tmp_path: Path, disk: DiskLayer, flush: bool
) -> None:
    session = make_session(tmp_path / "s", slots=1)
    disk.events.clear()
    journal, days = Journal(session, flush=flush), DayFiles(session, flush=flush)
    assert disk.flushed_after(0, session.root) == flush, "with its name"
    for number in range(2):
        disk.events.clear()
        journal.append("done", T0, slot="a")
        about = session.journal.stat()
        assert (("flush", about.st_ino, about.st_size) in disk.events) == flush
        days.append(IrradianceSample(T0 + timedelta(seconds=number), ghi_wm2=500.0))
        about = (session.irradiance / f"{T0:%Y-%m-%d}.csv").stat()
        assert (("flush", about.st_ino, about.st_size) in disk.events) == flush
        assert disk.flushed_after(0, session.irradiance) == (flush and number == 0)
    journal.close()
    days.close()


@pytest.mark.contract
def test_a_journal_without_its_torn_line_is_on_the_disk(tmp_path: Path, disk: DiskLayer) -> None:
    session = make_session(tmp_path / "s", slots=1)
    Journal(session).close()
    session.journal.write_bytes(encode_line({"event": "note"}) + b"half a li")
    disk.events.clear()
    Journal(session, flush=False).close()
    about = session.journal.stat()
    assert ("flush", about.st_ino, about.st_size) in disk.events
    assert session.journal.read_bytes() == encode_line({"event": "note"})


@pytest.mark.contract
def test_a_frame_is_on_the_disk_before_its_line_in_the_journal(rig: Field, disk: DiskLayer) -> None:
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    rig.run(replace(FAST, flush=True))
    folder, journal = rig.session.raw / rig.session.slots()[0].id, rig.session.journal.stat().st_ino
    places = [disk.renamed(path.name) for path in sorted(folder.glob("*.dng"))]
    assert len(places) == 3
    for place in places:
        after = [event[1] for event in disk.events[place + 1 :]]
        assert after.index(folder.stat().st_ino) < after.index(journal)
