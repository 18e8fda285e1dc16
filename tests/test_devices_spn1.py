"""devices: the SPN1's bytes, its driver on a pty, and everything that can go wrong on the wire."""

import os
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pty_instrument import PtyInstrument

from fieldlum.core.errors import DeviceError
from fieldlum.devices import open_pyranometer
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated import SimulatedSpn1
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.devices.spn1 import Spn1, parse_reading, parse_status

START = datetime(2027, 3, 20, 19, 30, tzinfo=UTC)
# SPN1 User Manual v1.0, appendix B: the reply to S, with its echo, and the lines of I.
READING = b"S 812.4, 104.9,1\r"
STATUS = b"SPN1 v1.03 Mar 13 2007\rUnits: W.m-2\r1mV radio off\rA106\r"


@pytest.mark.authority
def test_transcript_of_the_manual() -> None:
    assert parse_reading(READING) == (812.4, 104.9)
    assert parse_reading(b"   0.0,   0.0,0\r") == (0.0, 0.0)
    assert parse_status(STATUS) == ("v1.03 Mar 13 2007", "A106")


@pytest.mark.contract
@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"\r",
        b"S",
        b"S 812.4, 104.9,1",
        b" 812.4, 104",
        b"S 8#2.4,,1\r",
        b"S 812.4, 104.9,2\r",
        b"S 812, 104.9,1\r",
        b"S 12.4, 104.9,1\r",
        b"\xfe\x80S 812.4, 104.9,1\r",
        b"S 812.4, 104.9,1\r\n",
        b"S 9999.9, 104.9,1\r",
        b"S nan,104.9,1\r",
        b"? \xaf",
        b"S 812.4, 104.9,1\rS 812.4, 104.9,1\r",
        b"S-812.4, 104.9,1\r",
    ],
)
def test_a_broken_line_gives_no_number(reply: bytes) -> None:
    with pytest.raises(DeviceError, match="SPN1 answered"):
        parse_reading(reply)


@pytest.mark.contract
def test_other_units_are_refused() -> None:
    with pytest.raises(DeviceError, match="set to mV"):
        parse_status(STATUS.replace(b"W.m-2", b"mV"))


@pytest.mark.property
@settings(deadline=None, max_examples=200)
@given(st.integers(0, len(READING) - 1), st.binary(max_size=2), st.integers(0, 2))
def test_a_lost_or_added_byte_is_noticed(at: int, put: bytes, cut: int) -> None:
    line = READING[:at] + put + READING[at + cut :]
    try:
        reading = parse_reading(line)
    except DeviceError:
        return
    assert len(line.removeprefix(b"S")) == len(READING) - 1, (
        "only a byte turned into another digit can go unseen"
    )
    shown = f"{reading[0]:6.1f},{reading[1]:6.1f},".encode() + line[-2:]
    assert shown.replace(b" ", b"0") == line.removeprefix(b"S").replace(b" ", b"0")


class Wire:
    """Answers as the simulated SPN1, with a fault in between."""

    def __init__(self, light: SimulatedLight | None = None, noise_wm2: float = 0.0) -> None:
        self.light, self.sent = (
            light or SimulatedLight(ghi_wm2=812.4, dhi_wm2=104.9, dni_wm2=900.0),
            b"",
        )
        self.fault: Callable[[bytes], bytes] = lambda reply: reply
        self._sky = SimulatedSpn1(self, self, 1, noise_wm2)  # type: ignore[arg-type]

    def now(self) -> datetime:
        return START

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return self.light

    def _voice(self, data: bytes) -> bytes:
        out = b""
        for byte in data:
            command = bytes([byte])
            reading = self._sky.answer() if command == b"S" else b""
            out += {b"R": b"\xaf", b"S": b"S" + reading, b"I": b"I" + STATUS}.get(
                command, b"? \xaf"
            )
        return out

    def __call__(self, data: bytes) -> bytes:
        self.sent += data
        return self.fault(self._voice(data))


@contextmanager
def spn1(wire: Wire, timeout_s: float = 0.15) -> Iterator[Spn1]:
    instrument = PtyInstrument(wire)
    try:
        device = Spn1(instrument.port, FastClock(START), timeout_s=timeout_s)
        yield device
        device.close()
    finally:
        instrument.unplug()


@pytest.mark.contract
def test_the_real_driver_reads_the_simulated_bytes() -> None:
    wire = Wire()
    with spn1(wire) as device:
        sample = device.read()
        assert (sample.ghi_wm2, sample.dhi_wm2, sample.t_utc, sample.status) == (
            812.4,
            104.9,
            START,
            "",
        )
        assert sample.raw == "S 812.4, 104.9,1"
        assert device.info.serial == "A106" and device.info.gives == ("ghi", "dhi")
    assert set(wire.sent) <= set(b"RSI"), "only questions may ever be sent"


@pytest.mark.analytic
def test_total_below_diffuse_is_marked() -> None:
    with spn1(Wire(SimulatedLight(ghi_wm2=50.0, dhi_wm2=60.0, dni_wm2=0.0))) as device:
        assert device.read().status == "total below diffuse"


@pytest.mark.contract
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda reply: reply if reply == b"\xaf" else reply[:7], "SPN1 answered"),
        (lambda reply: reply if reply == b"\xaf" else b"\xfe\x80" + reply, "SPN1 answered"),
        (lambda reply: reply if reply == b"\xaf" else b"", "woke, but sends no reading"),
        (lambda reply: b"", "did not answer when woken"),
        (lambda reply: b"\x00", "when woken; expected 0xAF"),
    ],
    ids=["partial", "garbage", "mute", "dead", "wrong-baud"],
)
def test_faults_on_the_wire(fault: Callable[[bytes], bytes], said: str) -> None:
    wire = Wire()
    with spn1(wire) as device:
        wire.fault = fault
        with pytest.raises(DeviceError, match=said):
            device.read()
        wire.fault = lambda reply: reply
        assert device.read().ghi_wm2 == 812.4, "it must recover without being opened anew"


def _changed(*replies: bytes) -> Callable[[bytes], bytes]:
    """The next answers to S, one after the other; then the true ones."""
    left = list(replies)
    return lambda reply: left.pop(0) if reply != b"\xaf" and left else reply


SEVEN, BROKEN = b"S 712.4, 104.9,1\r", b"S 8#2.4, 104.9,1\r"


@pytest.mark.contract
@pytest.mark.parametrize("first", [(SEVEN,), (BROKEN,), (READING, SEVEN), (READING, BROKEN)])
def test_one_damaged_answer_is_outvoted(first: tuple[bytes, ...]) -> None:
    wire = Wire()
    with spn1(wire) as device:
        wire.sent, wire.fault = b"", _changed(*first)
        sample = device.read()
        assert sample.ghi_wm2 == 812.4 and sample.dhi_wm2 == 104.9 and wire.sent == b"RSRSRS"
        assert sample.raw.split(" | ")[0] == first[0].decode().strip(), (
            "every answer that differs is kept"
        )
        wire.sent = b""
        assert device.read().ghi_wm2 == 812.4 and wire.sent == b"RSRS", (
            "two questions where all is well"
        )


@pytest.mark.contract
@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ((SEVEN, b"S 612.4, 104.9,1\r", READING), "no two answers of the instrument agree"),
        ((BROKEN, BROKEN), "SPN1 answered"),
        ((BROKEN, SEVEN, READING), "no two answers of the instrument agree"),
    ],
)
def test_what_nobody_confirms_is_no_number(answers: tuple[bytes, ...], said: str) -> None:
    wire = Wire()
    with spn1(wire) as device:
        wire.fault = _changed(*answers)
        with pytest.raises(DeviceError, match=said):
            device.read()
        assert device.read().ghi_wm2 == 812.4


@pytest.mark.contract
def test_of_three_answers_the_nearest_two_count() -> None:
    wire = Wire()
    with spn1(wire) as device:
        wire.fault = _changed(
            b"S 815.9, 104.9,1\r"
        )  # a digit of the units: within what a sky may do, but a third is asked
        assert device.read().ghi_wm2 == 812.4
        wire.sent, wire.fault = b"", _changed(b"S 813.4, 104.9,1\r")  # within the noise
        assert device.read().ghi_wm2 == 813.4 and wire.sent == b"RSRS"


@pytest.mark.contract
def test_the_rest_of_a_late_reply_is_not_the_next_one() -> None:
    wire = Wire()
    with spn1(wire) as device:
        wire.fault = lambda reply: reply if reply == b"\xaf" else reply[:7]
        with pytest.raises(DeviceError):
            device.read()
        wire.light = SimulatedLight(ghi_wm2=400.0, dhi_wm2=300.0, dni_wm2=100.0)
        wire.fault = lambda reply: b"4, 104.9,1\r\xaf" if reply == b"\xaf" else reply
        with pytest.raises(DeviceError, match="when woken"):
            device.read()
        wire.fault = lambda reply: reply
        assert device.read().ghi_wm2 == 400.0


@pytest.mark.contract
def test_unplugged_is_a_device_error() -> None:
    instrument = PtyInstrument(Wire())
    device = Spn1(instrument.port, FastClock(START), timeout_s=0.15)
    instrument.unplug()
    with pytest.raises(DeviceError, match="/dev/"):
        device.read()
    device.close()
    with pytest.raises(DeviceError, match="/dev/"):
        Spn1(instrument.port, FastClock(START), timeout_s=0.15)


@pytest.mark.contract
def test_a_port_is_used_by_one_only() -> None:
    wire = Wire()
    with spn1(wire) as device, pytest.raises(DeviceError, match="close other programs that use it"):
        Spn1(device.info.port, FastClock(START), timeout_s=0.15)


@pytest.mark.contract
def test_a_silent_port_is_no_spn1() -> None:
    ours, theirs = os.openpty()
    tty.setraw(ours)
    with pytest.raises(DeviceError, match="did not answer when woken"):
        open_pyranometer(
            f"serial:{os.ttyname(theirs)}?kind=spn1&timeout=0.1", clock=FastClock(START)
        )
    os.close(ours)
    os.close(theirs)


@pytest.mark.contract
def test_sim_uri_opens_the_whole_chain() -> None:
    clock = FastClock(START)
    device = open_pyranometer("sim:office?seed=4&noise=0.5", clock=clock)
    first = device.read()
    clock.sleep(3600.0)
    later = device.read()
    assert first.ghi_wm2 is not None and first.dhi_wm2 is not None and 20 < first.ghi_wm2 < 1200
    assert later.ghi_wm2 != first.ghi_wm2 and first.ghi_wm2 >= first.dhi_wm2 - 3
    device.close()
    with pytest.raises(DeviceError, match="no simulated place 'cave'"):
        open_pyranometer("sim:cave", clock=clock)
    with pytest.raises(DeviceError, match="no kind"):
        open_pyranometer("serial:/dev/ttyUSB0", clock=clock)


@pytest.mark.contract
def test_a_port_is_found_again_by_its_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    from serial.tools.list_ports_common import ListPortInfo

    from fieldlum.devices.serial_port import resolve

    def plugged(device: str) -> list[ListPortInfo]:
        port = ListPortInfo(device)
        port.vid, port.pid, port.serial_number = 0x0403, 0x6001, "FT9Z"
        return [ListPortInfo("/dev/ttyS0"), port]

    for device in ("/dev/ttyUSB0", "/dev/ttyUSB1"):
        monkeypatch.setattr(
            "serial.tools.list_ports.comports", lambda device=device: plugged(device)
        )
        assert resolve("usb=0403:6001") == resolve("usb=0403:6001:ft9z") == device
    with pytest.raises(
        DeviceError,
        match=r"not plugged in; plug it in, or name one of these ports: 0403:6001:ft9z",
    ):
        resolve("usb=0403:6015")
    assert resolve("COM3") == "COM3"


@pytest.mark.contract
def test_a_port_that_does_not_open_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from serial.tools.list_ports_common import ListPortInfo

    from fieldlum.devices.serial_port import SerialLine, SerialPort

    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [ListPortInfo("/dev/ttyUSB1")])
    for port, found in ((str(tmp_path / "gone"), "No such file"), ("/dev/null", "Inappropriate")):
        said = rf"{port}: .*{found}.*; connected ports: /dev/ttyUSB1; name one of the connected"
        with pytest.raises(DeviceError, match=said):
            SerialPort(port, SerialLine(), timeout_s=0.1)
