"""devices: ASCII lines, TOA5 tables, CL-200A and T-10A: transcripts, damage, and the drivers on
ptys.
"""

import json
import os
import tty
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pty_instrument import PtyInstrument

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.devices import open_meter, open_pyranometer
from fieldlum.devices.ascii_lines import (
    AsciiField,
    AsciiProfile,
    LineForm,
    LineInstrument,
    crc16,
    load_ascii_profile,
    parse_line,
)
from fieldlum.devices.cl200a import (
    EXT_ON,
    HOLD,
    MEASURE,
    PC_MODE,
    READ_EVXY,
    READ_T10,
    FramedMeter,
    NotReady,
    bcc,
    frame,
    parse_answer,
    parse_t10_answer,
    unframe,
)
from fieldlum.devices.clock import FastClock
from fieldlum.devices.logger_files import LoggerFile, read_rows, text_table

START = datetime(2027, 3, 20, 15, tzinfo=UTC)
CLOCK = FastClock(START)


def nmea(body: str) -> bytes:
    total = 0
    for character in body.removeprefix("$"):
        total ^= ord(character)
    return f"{body}*{total:02X}\r\n".encode()


# ------------------------------------------------------------------------------------------ what a
# line means


@pytest.mark.contract
def test_shipped_profiles_read_their_own_example() -> None:
    keys = load_ascii_profile("arduino-keys")
    found = parse_line(keys, nmea("$G=812.4 D=104.9 T=24.1"))
    assert found == {"ghi_wm2": 812.4, "dhi_wm2": 104.9, "temperature_c": 24.1}
    assert (
        parse_line(load_ascii_profile("arduino-json"), b'{"G": 812.4, "T": 24}\n')["temperature_c"]
        == 24.0
    )
    assert parse_line(load_ascii_profile("millivolts"), b"G_mV=9.876\n")[
        "ghi_wm2"
    ] == pytest.approx(790.08)


@pytest.mark.contract
@pytest.mark.parametrize(
    "line",
    [
        b"G_mV=9.876",
        b"G_mV=9.87\n",
        b"G_mV=9,876\n",
        b"G_mV=\n",
        b"G_mV=nan\n",
        b"G_mV=inf\n",
        b"=9.876\n",
        b"\n",
        b"G_mV=9.876 G_mV=1.000\n",
        b"mV=9.876\n",
        b"G_mV=9.876\x00\n",
        b"\xffG_mV=9.876\n",
        b"G_mV=9.876 x\n",
        b"G_mV=99999.876\n",
        b"G_mV=1_0.876\n",
        b"G_mV=0x1.876\n",
        b"x" * 2000 + b"\n",
    ],
)
def test_broken_key_lines(line: bytes) -> None:
    with pytest.raises(DeviceError, match="line"):
        parse_line(load_ascii_profile("millivolts"), line)


@pytest.mark.contract
@pytest.mark.parametrize(
    "line",
    [
        b'{"G": 812.4}\n',
        b'{"G": 812.4, "T": 24',
        b'{"G": "x", "T": 2}\n',
        b'{"G": NaN, "T": 2}\n',
        b"[1, 2]\n",
        b'{"G": true, "T": 2}\n',
        b'{"G": 1, "G": 2, "T": 2}\n',
        b'{"G": {"G": 1}, "T": 2}\n',
        b'{"G": 1e9, "T": 2}\n',
        b"[" * 900 + b"\n",
        b'{"G": Infinity, "T": 2}\n',
        b'{"G": 1, "T": 2} {"G": 1, "T": 2}\n',
    ],
)
def test_broken_json_lines(line: bytes) -> None:
    with pytest.raises(DeviceError, match="line"):
        parse_line(load_ascii_profile("arduino-json"), line)


GOOD = nmea("$G=812.4 D=104.9 T=24.1")
KEYS = load_ascii_profile("arduino-keys")


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=200)
@given(st.integers(0, len(GOOD) - 1), st.binary(max_size=2), st.integers(0, 2))
def test_one_damage_under_a_checksum_gives_no_other_number(at: int, put: bytes, cut: int) -> None:
    with suppress(DeviceError):
        values = parse_line(KEYS, GOOD[:at] + put + GOOD[at + cut :])
        assert (
            values == {"ghi_wm2": 812.4, "dhi_wm2": 104.9, "temperature_c": 24.1}
            or len(put) == cut == 2
        )


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=200)
@given(st.floats(-150, 3900), st.floats(-50, 80))
def test_what_is_printed_is_read(ghi: float, warm: float) -> None:
    line = json.dumps({"n": 1, "T": round(warm, 2), "G": round(ghi, 3)}).encode() + b"\n"
    if b"e-" not in line:
        found = parse_line(load_ascii_profile("arduino-json"), line)
        assert found["ghi_wm2"] == round(ghi, 3) and found["temperature_c"] == round(warm, 2)


FIXED = AsciiProfile(
    "fixed",
    "regex",
    (
        AsciiField("ghi_wm2", "G", decimals=1, lowest=-10.0, highest=1600.0),
        AsciiField("temperature_c", "T", decimals=1),
    ),
    pattern=r"G=(?P<G>[ \d.+-]{6})W T=(?P<T>[ \d.+-]{5})",
)


@pytest.mark.contract
def test_what_is_known_of_a_line_is_held_against_it() -> None:
    assert parse_line(FIXED, b"G=0812.4W T=024.1\n") == {"ghi_wm2": 812.4, "temperature_c": 24.1}
    for line, said in (
        (b"G=812.4W T=024.1\n", "does not fit the pattern"),
        (b"G=081.24W T=024.1\n", "expected a number with 1 decimals"),
        (b"G=0812.4 T=024.1\n", "does not fit the pattern"),
        (b"G=1812.4W T=024.1\n", "expected -10 to 1600"),
        (b"T=024.1 G=0812.4W\n", "does not fit the pattern"),
    ):
        with pytest.raises(DeviceError, match=said):
            parse_line(FIXED, line)


@pytest.mark.analytic
def test_crc_of_a_line() -> None:
    assert (
        crc16(b"123456789") == 0x4B37
    )  # the check value that Greg Cook's catalogue gives for CRC-16/MODBUS
    profile = load_ascii_profile("arduino-crc")
    line = f"$G=812.4 D=104.9 T=24.1*{crc16(b'G=812.4 D=104.9 T=24.1'):04x}\r\n".encode()
    assert parse_line(profile, line) == {"ghi_wm2": 812.4, "dhi_wm2": 104.9, "temperature_c": 24.1}
    own, due = line.decode().rstrip()[-4:], f"{crc16(b'G=821.4 D=104.9 T=24.1'):04X}"
    with pytest.raises(DeviceError, match=rf"the checksum \*{own}; expected \*{due}; check"):
        parse_line(profile, line.replace(b"812", b"821"))
    with pytest.raises(DeviceError, match=r"has no checksum; expected \* and 4 hex"):
        parse_line(profile, line.replace(b"*", b""))


# ------------------------------------------------------------------------------------------ the
# form of a stream


def learned(*lines: str) -> LineForm:
    form = LineForm()
    for _ in range(60 // len(lines)):
        assert [form.difference(line) for line in lines] == [""] * len(lines)
    return form


@pytest.mark.contract
@pytest.mark.parametrize(
    ("lines", "odd", "said"),
    [
        (
            ['{"G": 812.4, "T": 24.1}'],
            '{"G": 812, "T": 24.1}',
            """'{"G":#, "T":#0}'""",
        ),
        (['{"G": 812.4, "T": 24.1}'], '{"G": 8124, "T": 24.1}', """have '{"G":#0, "T":#0}'"""),
        (['{"G": 812.4, "T": 24.1}'], '{"G": 812.4, "U": 24.1}', '"U"'),
        (["G=812.4 T=24.1"], "G=812.4  24.1", "its form is 'G=#0#0'"),
    ],
)
def test_a_line_unlike_all_before_it_is_noticed(lines: list[str], odd: str, said: str) -> None:
    assert said in learned(*lines).difference(odd)


@pytest.mark.contract
def test_a_form_that_varies_or_changes_for_good_is_no_damage() -> None:
    assert not learned("G=812.4 T=24.1", "G=812 T=24.1").difference("G=813 T=24.1"), (
        "noughts that are not printed"
    )
    assert not learned("G=812.4", "G=9.4", "G=1012.4").difference("G=88.1"), (
        "numbers that are not filled to a width"
    )
    form = learned("G=812.4 sky=clear")
    assert [bool(form.difference("G=812.4 sky=cloudy")) for _ in range(5)] == [
        True,
        True,
        False,
        False,
        False,
    ]
    few = LineForm()
    assert {few.difference(text) for text in ("G=1.0", "G=1", "H=1", "G=1.00")} == {""}, (
        "too few to know"
    )


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.tuples(st.integers(-20, 14000), st.integers(-300, 600)), min_size=60, max_size=100),
    st.sampled_from(
        [
            "G={0:.1f} T={1:.1f}",
            "G={0:6.1f},{1:5.1f}",
            "G={0:06.1f} T={1:05.1f}",
            '{{"G": {0}, "T": {1}}}',
        ]
    ),
)
def test_no_whole_line_is_refused(values: list[tuple[int, int]], how: str) -> None:
    form = LineForm()
    assert not [said for g, t in values if (said := form.difference(how.format(g / 10, t / 10)))]


@pytest.mark.contract
def test_profiles_are_checked(tmp_path: Path) -> None:
    with pytest.raises(
        DeviceError, match=r"no profile of text lines 'x'; expected one of .*arduino-json"
    ):
        load_ascii_profile("x")
    own = tmp_path / "own.toml"
    for text, said in (
        ('name="a"\nform="regex"\npattern="("\nentry=[{quantity="ghi_wm2",key="g"}]', "pattern:"),
        (
            'name="a"\nform="regex"\npattern="(?P<x>1)"\nentry=[{quantity="ghi_wm2",key="g"}]',
            "no group named g",
        ),
        (
            'name="a"\nform="json"\nentry=[{quantity="temperature_c",key="g"}]',
            "at least one of ghi_wm2",
        ),
        ('name="a"\nform="json"\nentry=[{quantity="ghi",key="g"}]', "'ghi'"),
    ):
        own.write_text(text)
        with pytest.raises(InputError, match=said):
            load_ascii_profile(str(own))


# ------------------------------------------------------------------------------------------ a
# talking instrument


@pytest.fixture
def talker() -> Iterator[tuple[int, str]]:
    """A pty; what the test writes to the handle is what the instrument says."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    yield ours, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


@pytest.mark.contract
def test_newest_whole_line_counts_and_the_rest_waits(talker: tuple[int, str]) -> None:
    ours, port = talker
    device = open_pyranometer(
        f"serial:{port}?kind=ascii&profile=arduino-json&silence=0.3", clock=CLOCK
    )
    assert isinstance(device, LineInstrument) and device.info.gives == ("ghi",)
    os.write(ours, b'4}\n{"G": 1, "T": 2}\nboot\n{"G": 3, "T": 2}\n{"G": 5')
    assert device.read().ghi_wm2 == 3.0 and len(device.refused()) == 1
    os.write(ours, b'00, "T": 2}\n')
    sample = device.read()
    assert (sample.ghi_wm2, sample.raw, sample.t_utc) == (500.0, '{"G": 500, "T": 2}', START)
    device.close()


@pytest.mark.analytic
def test_of_three_quick_lines_the_median_counts(talker: tuple[int, str]) -> None:
    ours, port = talker
    device = LineInstrument(port, load_ascii_profile("arduino-json"), CLOCK, silence_s=0.3)
    os.write(
        ours, b'\n{"G": 1, "T": 2}\n{"G": 811, "T": 22}\n{"G": 81, "T": 21}\n{"G": 812, "T": 23}\n'
    )
    sample = device.read()
    assert (sample.ghi_wm2, sample.temperature_c) == (811.0, 22.0)
    assert sample.raw == '{"G": 811, "T": 22} | {"G": 81, "T": 21} | {"G": 812, "T": 23}'
    slow = FastClock(START)
    device._clock = slow
    slow.sleep(60.0)
    os.write(ours, b'{"G": 1, "T": 2}\n{"G": 2, "T": 2}\n{"G": 400, "T": 21}\n')
    assert device.read().ghi_wm2 == 400.0, "lines that are far apart do not vote"
    device.close()


@pytest.mark.contract
def test_a_line_of_another_form_gives_no_number_and_is_handed_out(talker: tuple[int, str]) -> None:
    ours, port = talker
    device = LineInstrument(port, load_ascii_profile("arduino-json"), CLOCK, silence_s=0.3)
    assert not device.info.is_checked
    os.write(ours, b"\n" + 30 * b'{"G": 811.5, "T": 22.0}\n')
    assert device.read().ghi_wm2 == 811.5 and device.refused() == []
    os.write(ours, b'{"G": 811, "T": 22.0}\nboot\n{"G": 811.0, "T": 22.0}\n')
    assert device.read().ghi_wm2 == 811.0
    first, second = device.refused()
    assert "its form is" in first and r"""b'{"G": 811, "T": 22.0}\n'""" in first
    assert "boot" in second and device.refused() == []
    device.close()


@pytest.mark.contract
def test_silence_and_noise(talker: tuple[int, str]) -> None:
    ours, port = talker
    device = LineInstrument(port, load_ascii_profile("millivolts"), CLOCK, silence_s=0.15)
    with pytest.raises(DeviceError, match="no line received"):
        device.read()
    os.write(ours, b"\n\xf0\x81\xfe\n")
    with pytest.raises(DeviceError, match="has bytes that are not ASCII text"):
        device.read()
    device.close()


# ------------------------------------------------------------------------------------------ TOA5

TOA5 = (
    '"TOA5","Roof","CR1000X","12345","CR1000X.Std.05","CPU:sun.CR1X","9","Table1"\n'
    '"TIMESTAMP","RECORD","GHI_Avg","DHI_Avg","PTemp_C"\n"TS","RN","W/m^2","W/m^2","Deg '
    'C"\n"","","Avg","Avg","Smp"\n'
    '"2027-03-20 08:00:00",100,512.3,88.1,21.5\n"2027-03-20 08:01:00",101,"NAN",88.2,21.5\n'
    '"2027-03-20 08:02:00",104,515.0,88.4,21.6\n'
)


def parse_toa5(
    text: str, utc_offset: timedelta, columns: dict[str, str] | None = None
) -> LoggerFile:
    path = Path("a.dat")
    return read_rows(path, text_table(path, text), utc_offset, columns or {}, {})


@pytest.mark.authority
def test_toa5_table() -> None:
    table = parse_toa5(TOA5, timedelta(hours=-8))
    first, second, third = table.samples
    assert first.t_utc == datetime(2027, 3, 20, 16, 0, tzinfo=UTC)
    assert (first.ghi_wm2, first.dhi_wm2, first.temperature_c) == (512.3, 88.1, 21.5)
    assert second.ghi_wm2 is None and second.dhi_wm2 == 88.2
    assert third.ghi_wm2 == 515.0 and not table.left_out


@pytest.mark.contract
def test_toa5_damage() -> None:
    broken = (
        TOA5 + '"2027-03-20 08:03:00",105,5#5.0,88.4,21.6\n"2027-03-20 08:0",1,1,1,1\n"2027-03-20 '
        '08:04:00",106,51'
    )
    table = parse_toa5(broken, timedelta())
    assert len(table.samples) == 3 and len(table.left_out) == 3
    assert "line 8: ghi_wm2 is '5#5.0'" in table.left_out[0] and "line feed" in table.left_out[2]
    for text, said in (
        ('"TOA5","Roof"\n"TIMESTAMP","GHI"\n', "no complete TOA5 header in the first four lines"),
        (TOA5.replace('"","","Avg","Avg","Smp"\n', ""), "no complete TOA5 header"),
        (TOA5.replace("GHI_Avg", "Volt").replace("DHI_Avg", "Amp"), "a column of irradiance"),
        (TOA5.replace("W/m^2", "mV"), "GHI_Avg is in 'mV'"),
        (TOA5.replace("DHI_Avg", "GHI_2_Avg"), "several columns for ghi_wm2: GHI_Avg, GHI_2_Avg"),
    ):
        with pytest.raises(InputError, match=said):
            parse_toa5(text, timedelta())
    named = parse_toa5(TOA5, timedelta(), {"dni_wm2": "GHI_Avg"})
    assert named.samples[0].dni_wm2 == 512.3 and named.samples[0].ghi_wm2 is None
    assert named.samples[0].dhi_wm2 == 88.1  # the columns that are not named are found as usual
    with pytest.raises(InputError, match="no column Nope"):
        parse_toa5(TOA5, timedelta(), {"ghi_wm2": "Nope"})


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=200)
@given(st.integers(0, len(TOA5) - 1), st.text(max_size=3), st.integers(0, 3))
def test_damaged_toa5_reads_or_is_refused(at: int, put: str, cut: int) -> None:
    with suppress(InputError):
        parse_toa5(TOA5[:at] + put + TOA5[at + cut :], timedelta())


# ------------------------------------------------------------------------------------------ CL-200A


@pytest.mark.authority
def test_check_digits() -> None:
    # Konica Minolta CS-A32T technical note.
    digits = {PC_MODE: b"13", HOLD: b"02", EXT_ON: b"06", MEASURE: b"04", READ_EVXY: b"02"}
    assert {command: bcc(command) for command in digits} == digits
    assert frame(b"00021200") == b"\x0200021200\x0302\r\n"


def answer(status: bytes = b"    ", values: bytes = b"+12343+ 3130+ 3290") -> bytes:
    return frame(b"0002" + status + values)


@pytest.mark.analytic
def test_values() -> None:
    assert parse_answer(answer()) == parse_answer(answer(b"   1")) == pytest.approx(123.4)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("reply", "said"),
    [
        (answer(b" 1  "), "head was switched off"),
        (answer(b" 4  "), "has not measured yet"),
        (answer(b" 5  "), "over the meter's range"),
        (answer(b"  6 "), "changes its range"),
        (answer(values=b"+99999+ 3130+ 3290"), "expected 0 to 200000 lx"),
        (answer()[:-1], "right check digits"),
        (answer().replace(b"+1234", b"+1235"), "right check digits"),
        (frame(b"0054    "), "without values"),
        (b"", "right check digits"),
    ],
)
def test_errors_of_the_meter(reply: bytes, said: str) -> None:
    with pytest.raises(DeviceError, match=said):
        parse_answer(reply)


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=300)
@given(st.integers(0, len(answer()) - 1), st.integers(1, 255))
def test_one_wrong_byte_is_always_noticed(at: int, flip: int) -> None:
    reply = bytearray(answer())
    reply[at] ^= flip
    with pytest.raises(DeviceError):
        parse_answer(bytes(reply))


@pytest.mark.contract
def test_the_driver_on_a_pty() -> None:
    asked: list[bytes] = []
    replies = [answer(b"  6 "), answer(values=b"+45674+33300+33400")]

    def meter(data: bytes) -> bytes:
        out = b""
        for one in data.splitlines(keepends=True):
            asked.append(body := unframe(one).encode())
            mute = body in (HOLD, MEASURE)
            out += (
                b"" if mute else replies.pop(0) if body == READ_EVXY else frame(body[:4] + b"    ")
            )
        return out

    instrument = PtyInstrument(meter)
    device = open_meter(f"cl200a:{instrument.port}?parity=N", clock=CLOCK)
    assert device.read() == pytest.approx(4567.0)
    assert asked[:3] == [PC_MODE, HOLD, EXT_ON] and asked.count(MEASURE) == 2
    device.close()
    instrument.unplug()
    with pytest.raises(DeviceError, match="/dev/"):
        FramedMeter(instrument.port, CLOCK.sleep, parity="N", head=None)


def t10_answer(head: int = 3, status: bytes = b"0 30", value: bytes = b"+45674") -> bytes:
    return frame(b"%02d10" % head + status + value + 12 * b" ")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("reply", "said"),
    [
        (t10_answer(status=b"0130"), "head was switched off"),
        (t10_answer(status=b"0550"), "over the meter's range"),
        (t10_answer(status=b"0930"), "error 9"),
        (t10_answer(4), "head 03 was asked"),
        (t10_answer(value=b"+99999"), "expected 0 to 299900 lx"),
        (t10_answer(value=b"-00124"), "expected 0 to 299900 lx"),
        (t10_answer(value=b"      "), "head 03 was asked"),
        (t10_answer()[:-1], "right check digits"),
    ],
)
def test_errors_of_a_chain_of_meters(reply: bytes, said: str) -> None:
    with pytest.raises(DeviceError, match=said) as caught:
        parse_t10_answer(reply, 3)
    assert not isinstance(caught.value, NotReady)


@pytest.mark.contract
def test_one_head_of_a_chain_on_a_pty() -> None:
    """Heads 3 and 12 of a chain with different light; the second changes its range at first."""
    values, ranges, asked = (
        {3: b"+45674", 12: b"+12343"},
        [b"0 00", b"0 00", b"0733"],
        list[bytes](),
    )

    def chain(data: bytes) -> bytes:
        out = b""
        for one in data.splitlines(keepends=True):
            asked.append(body := unframe(one).encode())
            head = int(body[:2])
            if body == PC_MODE:
                out += frame(b"0054    ")
            elif body[2:] == READ_T10 and head in values:
                status = ranges.pop(0) if head == 12 else b"0 30"
                out += t10_answer(head, status, values[head])
        return out

    instrument = PtyInstrument(chain)
    for head, lx in ((3, 4567.0), (12, 123.4)):
        device = open_meter(f"t10a:{instrument.port}?parity=N&head={head}", clock=CLOCK)
        assert device.info.model == "Konica Minolta T-10A"
        assert device.read() == pytest.approx(lx)
        device.close()
    assert asked[:3] == [PC_MODE, b"03100200", b"03100200"] and not ranges
    with pytest.raises(DeviceError, match="does not answer"):
        open_meter(f"t10a:{instrument.port}?parity=N&head=7", clock=CLOCK)
    with pytest.raises(DeviceError, match=r"head = .30., expected a number <= 29"):
        open_meter(f"t10a:{instrument.port}?head=30", clock=CLOCK)
    with pytest.raises(DeviceError, match="unknown option 'head'"):
        open_meter(f"cl200a:{instrument.port}?head=3", clock=CLOCK)
    instrument.unplug()


@pytest.mark.contract
def test_regex_profile_by_hand() -> None:
    profile = AsciiProfile(
        "x", "regex", (AsciiField("ghi_wm2", "g", 2.0, 1.0),), pattern=r"I(?P<g>\d+)"
    )
    assert parse_line(profile, b"I12\r\n") == {"ghi_wm2": 25.0}
