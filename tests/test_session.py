"""Session folder: plan round trip, append-only files that survive being cut anywhere."""

import os
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum.capture.doctor import check_journal
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.files import cut_torn_tail, decode_line, encode_line
from fieldlum.core.records import Exposure, IrradianceSample, SiteFile, Slot
from fieldlum.learn.models import seen_of
from fieldlum.session import (
    PLAN_COLUMNS,
    DayFiles,
    Journal,
    Session,
    check_writable,
    codec,
    create_session,
    day_files,
    encode_sample,
    exposure_text,
    marks,
    open_session,
    read_day,
    read_journal,
    read_plan,
    sole_user,
)
from fieldlum.session.day_files import decode_sample
from fieldlum.session.journal import JournalEvent, damaged_lines, decode_event
from fieldlum.session.plan_file import parse_exposure
from fieldlum.session.slot_states import apply_events

NOON = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)
SETUP = SiteFile(SEATTLE)


@pytest.fixture
def session(tmp_path: Path) -> Session:
    slots = [
        Slot(NOON, 10.0, 120.0, (Exposure(1 / 250, 5.6), Exposure(2.0, 5.6, 100, "nd3")), ("sun",))
    ]
    return create_session(tmp_path / "s", SETUP, slots, {"set": "test"})


@pytest.mark.property
def test_plan_and_site_round_trip(session: Session) -> None:
    again = open_session(session.root)
    assert again.site_file() == SETUP
    assert again.slots()[0].exposures == (Exposure(1 / 250, 5.6), Exposure(2.0, 5.6, 100, "nd3"))
    with pytest.raises(InputError, match="already a session"):
        create_session(session.root, SETUP, [], {})
    session.toml.unlink()  # a kill before it was written
    create_session(session.root, SETUP, [], {})
    session.toml.unlink()
    session.plan.write_text("my own shopping plan\n")
    with pytest.raises(InputError, match=r"a plan\.csv of another program"):
        create_session(session.root, SETUP, [], {})
    assert session.plan.read_text() == "my own shopping plan\n"


@pytest.mark.contract
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            (b"; ", b", "),
            "8 cells; expected 7 cells",
        ),  # a bracket of one frame, its second taken for a tag
        ((b",", b";"), "plan.csv: columns separated by ';'"),
        ((b"exposures", b"shutters"), "no column exposures; expected columns"),
    ],
)
def test_a_plan_that_a_spreadsheet_spoilt_is_refused(
    session: Session, damage: tuple[bytes, bytes], said: str
) -> None:
    session.plan.write_bytes(session.plan.read_bytes().replace(*damage))
    with pytest.raises(InputError, match=said):
        session.slots()
    session.plan.write_bytes(b"")
    with pytest.raises(InputError, match="an empty file; expected columns"):
        session.slots()


@pytest.mark.property
@given(
    st.floats(1e-5, 600),
    st.floats(1, 32),
    st.sampled_from([50, 100, 6400]),
    st.sampled_from(["", "nd3"]),
)
@settings(deadline=None)
def test_exposure_text_round_trips(shutter: float, f_number: float, iso: int, nd: str) -> None:
    text = exposure_text(Exposure(shutter, f_number, iso, nd))
    for wrong in (f"{text} hello", "1/250 f/5.6 ISO100 hello"):
        with pytest.raises(ValueError):
            parse_exposure(wrong)
    back = parse_exposure(text)
    assert back.shutter_s == pytest.approx(shutter, rel=2e-5)
    assert back.f_number == pytest.approx(f_number, rel=1e-5)
    assert (back.iso, back.nd) == (iso, nd)


@pytest.mark.contract
@pytest.mark.parametrize(
    "exposure",
    [
        *("1/0 f/5.6 ISO100", "nan f/5.6 ISO100", "1/4 f/0 ISO100", "\xff"),
        *("1/4 5.6 ISO100", "1/4 f/5.6 100", "1/4 f/5.6 XXX100"),
    ],
)
def test_a_plan_with_an_impossible_exposure_is_an_input_error(
    tmp_path: Path, exposure: str
) -> None:
    path = tmp_path / "plan.csv"
    row = f"20270320T153000Z,2027-03-20T15:30:00Z,08:30,20,120,{exposure},"
    path.write_text(f"{','.join(PLAN_COLUMNS)}\n{row}\n", encoding="latin-1")
    with pytest.raises(InputError, match="expected columns slot"):
        read_plan(path)


@pytest.mark.slow
@pytest.mark.property
@given(st.text(), st.text(), st.one_of(st.none(), st.floats(-10, 1500)))
@settings(deadline=None)
def test_day_row_holds_any_text_on_one_line(status: str, raw: str, ghi: float | None) -> None:
    line = encode_sample(
        IrradianceSample(
            NOON, ghi_wm2=ghi, dhi_wm2=None, dni_wm2=3.5, temperature_c=None, status=status, raw=raw
        )
    )
    assert line.count(b"\n") == 1 and line.endswith(b"\n")
    back = decode_sample(line)
    assert back is not None and back.t_utc == NOON and back.dni_wm2 == 3.5
    assert back.ghi_wm2 == (None if ghi is None else pytest.approx(ghi, rel=1e-6, abs=1e-30))


@pytest.mark.property
@given(st.integers(0, 200), st.integers(0, 255))
@settings(deadline=None)
def test_a_changed_byte_is_never_read(at: int, byte: int) -> None:
    for line, decode in (
        (
            encode_sample(
                IrradianceSample(NOON, ghi_wm2=812.4, dhi_wm2=104.9, raw="S 812.4, 104.9,1")
            ),
            decode_sample,
        ),
        (
            encode_line(
                {"event": "frame", "t_utc": "2027-03-20T15:30:00Z", "slot": "20270320T153000Z"}
            ),
            decode_line,
        ),
    ):
        at %= len(line) - 1
        changed = line[:at] + bytes([byte]) + line[at + 1 :]
        # Hex digits of the CRC may change case: the same figure.
        assert decode(changed) is None or changed.lower() == line.lower()


def _journal_lines(session: Session, count: int) -> list[bytes]:
    journal = Journal(session)
    for i in range(count):
        journal.append("frame", NOON + timedelta(seconds=i), slot="s", index=i)
    journal.close()
    return session.journal.read_bytes().splitlines(keepends=True)


@pytest.mark.property
def test_journal_cut_at_every_byte_keeps_whole_lines(session: Session) -> None:
    lines = _journal_lines(session, 5)
    whole = b"".join(lines)
    head = b"".join(lines[:3])
    for cut in range(len(head), len(whole) + 1):
        session.journal.write_bytes(whole[:cut])
        Journal(session).close()
        kept = sum(1 for n in range(len(lines) + 1) if len(b"".join(lines[:n])) <= cut) - 1
        assert session.journal.read_bytes() == b"".join(lines[:kept])
        assert len(read_journal(session)) == kept


@pytest.mark.contract
def test_zeroed_pages_are_cut_and_kept_aside(session: Session) -> None:
    whole = b"".join(_journal_lines(session, 3))
    session.journal.write_bytes(whole + b"\0" * 4096)
    Journal(session).close()
    assert session.journal.read_bytes() == whole
    assert session.journal.with_name("journal.jsonl.torn").stat().st_size == 4096


@pytest.mark.contract
def test_harm_in_the_middle_is_skipped_not_cut(session: Session) -> None:
    lines = _journal_lines(session, 4)
    lines[1] = lines[1].replace(b"frame", b"fr4me")
    session.journal.write_bytes(b"".join(lines))
    Journal(session).close()
    assert [dict(event)["index"] for event in read_journal(session)] == [0, 2, 3]


@pytest.mark.contract
def test_an_edited_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text("a\nb\nc\nd\n")
    with pytest.raises(InputError, match="no valid line at the end"):
        cut_torn_tail(path, lambda line: False)
    assert path.read_text() == "a\nb\nc\nd\n"


@pytest.mark.contract
def test_day_files_split_at_utc_midnight_and_recover(session: Session) -> None:
    log = DayFiles(session)
    late = datetime(2027, 3, 20, 23, 59, 58, tzinfo=UTC)
    for i in range(4):
        log.append(IrradianceSample(late + timedelta(seconds=i), ghi_wm2=float(i)))
    log.close()
    assert [p.name for p in day_files(session)] == ["2027-03-20.csv", "2027-03-21.csv"]
    second = day_files(session)[1]
    second.write_bytes(second.read_bytes()[:-3])
    log = DayFiles(session)
    log.append(IrradianceSample(late + timedelta(seconds=9), ghi_wm2=9.0))
    log.close()
    samples, broken = read_day(second)
    assert ([s.ghi_wm2 for s in samples], broken) == ([2.0, 9.0], 0)


@pytest.mark.contract
def test_full_disk_takes_half_a_line_back(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(session)
    journal.append("started", NOON)
    before = session.journal.read_bytes()
    real_write = os.write

    def full(handle: int, data: bytes) -> int:
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return real_write(handle, data[:20])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"):
        journal.append("done", NOON, slot="x" * 40)
    monkeypatch.undo()
    assert session.journal.read_bytes() == before


@pytest.mark.contract
def test_only_one_capture_at_a_time(session: Session) -> None:
    number = "" if sys.platform == "win32" else rf" \(process {os.getpid()}\)"
    with (
        sole_user(session, "capture"),
        pytest.raises(InputError, match=f"another fieldlum{number} captures"),
        sole_user(session, "capture"),
    ):
        pass
    if sys.platform != "win32":  # nobody can write a locked file there
        with (
            sole_user(session, "capture"),
            pytest.raises(InputError, match="another fieldlum captures"),
        ):
            (session.root / ".capture.lock").write_text("0\n")
            with sole_user(session, "capture"):
                pass


@pytest.mark.contract
def test_scraps_of_killed_runs_are_removed_after_a_day(tmp_path: Path) -> None:
    old, new = tmp_path / ".1234.tmp.a.exr", tmp_path / ".5678.tmp.b.exr"
    for path in (old, new):
        path.touch()
    os.utime(old, (0.0, 0.0))
    (tmp_path / ".maps.zarr.tmp").mkdir()
    check_writable(tmp_path)  # as each stage does before it writes
    assert not old.exists() and new.exists() and (tmp_path / ".maps.zarr.tmp").is_dir()


WRONG_EVENTS = (
    [1, 2],
    "done",
    {},
    {"event": "done"},
    {"event": 5, "t_utc": "2027-03-20T15:30:00Z"},
    {"event": "done", "t_utc": 5},
    {"event": "done", "t_utc": "9999-12-31T23:59:59-12:00"},
    {"event": "done", "t_utc": "9999-12-31T23:59:59Z"},
    {"event": "done", "t_utc": "noon"},
    {"event": "back", "t_utc": "2027-03-20T15:30:00Z", "after_s": 1e308},
    {"event": "slept", "t_utc": "2027-03-20T15:30:00Z", "seconds": float("nan")},
    {"event": "done", "t_utc": "2027-03-20T15:30:00Z", "slot": ["a"]},
    {"event": "started", "t_utc": "2027-03-20T15:30:00Z", "slot": "a", "attempt": "first"},
    {"event": "illuminance", "t_utc": "2027-03-20T15:30:00Z", "slot": "a", "illuminance_lx": "5"},
    {"event": "frame", "t_utc": "2027-03-20T15:30:00Z", "slot": "a", "frame": {"file": "a.dng"}},
    {"event": "frame", "t_utc": "2027-03-20T15:30:00Z", "slot": "a", "frame": 5},
    {"event": "marked", "t_utc": "2027-03-20T15:30:00Z", "slot": "a", "state": "lamp=blue"},
)


@pytest.mark.contract
def test_lines_with_a_valid_checksum_and_wrong_types_are_named(session: Session) -> None:
    good = _journal_lines(session, 2)
    wrong = [encode_line(row) for row in WRONG_EVENTS]  # type: ignore[arg-type]
    session.journal.write_bytes(b"".join([good[0], *wrong, good[1], b"1234 half a li"]))
    assert [dict(event)["index"] for event in read_journal(session)] == [0, 1]
    assert damaged_lines(session) == list(range(2, 2 + len(wrong)))
    assert marks(session) == {} and apply_events(read_journal(session)).counts == {"frame": 2}
    text = "journal.jsonl has 17 damaged lines (2, 3, 4, 5, 6 and 12 more)"
    result = CliRunner().invoke(main, ["status", str(session.root)])
    assert result.exit_code == 0 and text in result.stdout
    (finding,) = check_journal(session)
    assert finding.verdict == "warn" and finding.text.startswith(text)


@pytest.mark.property
@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text(), st.lists, max_leaves=3))
@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_no_value_of_an_event_breaks_the_ledger(value: object) -> None:
    row: dict[str, object] = {"event": "retake", "t_utc": "2027-03-20T15:30:00Z", "slot": "a"}
    for name in ("event", "t_utc", "slot", "attempt", "frame", "why", "state", "illuminance_lx"):
        if (event := decode_event(encode_line({**row, name: value}))) is not None:
            apply_events([event])


@pytest.mark.contract
def test_the_ledger_keeps_the_last_start_of_a_capture() -> None:
    """A restarted capture compares the clock with it."""
    events: list[JournalEvent] = [
        {"event": kind, "t_utc": f"2027-03-20T15:3{minute}:00Z"}
        for minute, kind in enumerate(("open", "close", "open", "note"))
    ]
    assert (
        apply_events(events).last_open == events[2] and apply_events(events[3:]).last_open is None
    )


@pytest.mark.contract
def test_arrays_that_expand_without_limit_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "weights.npz"
    np.savez_compressed(path, seen=np.zeros(2**21, np.uint8))
    with codec.open_arrays(path, "a mask", "train again") as stored:
        assert stored["seen"].size == 2**21
    assert seen_of(tmp_path) is not None
    monkeypatch.setattr(codec, "MAX_PICTURES_BYTES", 2**20)
    with (
        pytest.raises(InputError, match="would fill 2097"),
        codec.open_arrays(path, "a mask", "train again"),
    ):
        pass
    assert seen_of(tmp_path) is None
