"""devices: Modbus RTU pyranometers on ptys, their registers as data, and every fault of the
line.
"""

import asyncio
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pty_instrument import PtyInstrument

from fieldlum.core.errors import DeviceError, InputError
from fieldlum.devices import open_pyranometer
from fieldlum.devices.clock import FastClock
from fieldlum.devices.modbus import (
    Decoded,
    RegisterProfile,
    date_text,
    decode,
    load_register_profile,
    raw_value,
)

START = datetime(2027, 3, 20, 15, tzinfo=UTC)
# Worked reply in the Kipp & Zonen SMP manual: mode 1, status 0, scale 0, 997 W/m2, 24.8 C, 23.4 V.
SMP = dict(enumerate([633, 107, 1, 0, 0, 0x03E5, 0x03E5, 0, 0x00F8, 0x00EA]))


def crc16(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def floats(register: int, value: float) -> dict[int, int]:
    return dict(
        zip((register, register + 1), struct.unpack(">HH", struct.pack(">f", value)), strict=True)
    )


class Bus:
    """Instruments on an RTU line: answers reads of `units`, refuses all else, keeps what was
    sent.
    """

    def __init__(self, units: dict[int, dict[int, int]], largest: int = 125) -> None:
        self.units, self.largest = units, largest
        self._held = b""
        self.fault: Callable[[bytes], bytes] = lambda reply: reply
        self.sent: list[bytes] = []

    def __call__(self, data: bytes) -> bytes:
        self._held += data
        if len(self._held) < 8:
            return b""
        request, self._held = self._held[:8], self._held[8:]
        self.sent.append(request)
        return self.fault(self._reply(request))

    def _reply(self, request: bytes) -> bytes:
        unit, function, start, count = struct.unpack(">BBHH", request[:6])
        if crc16(request[:6]) != request[6:] or unit not in self.units:
            return b""
        registers = self.units[unit]
        wanted = range(start, start + count)
        if (
            function not in (3, 4)
            or count > self.largest
            or any(r not in registers for r in wanted)
        ):
            body = struct.pack(">BBB", unit, function | 0x80, 2)
        else:
            body = struct.pack(
                f">BBB{count}H", unit, function, 2 * count, *(registers[r] for r in wanted)
            )
        return body + crc16(body)


@contextmanager
def bus(
    units: dict[int, dict[int, int]], options: str, largest: int = 125
) -> Iterator[tuple[Bus, object]]:
    line = Bus(units, largest)
    instrument = PtyInstrument(line)
    try:
        # A pty has no parity: opening it a second time with one fails (the kernel drops the flag).
        uri = f"modbus:{instrument.port}?parity=N&timeout=0.15&{options}"
        device = open_pyranometer(uri, clock=FastClock(START))
        yield line, device
        device.close()
    finally:
        instrument.unplug()


@pytest.mark.authority
def test_checksum() -> None:
    # Request printed in the Apogee SP-422 manual.
    assert bytes.fromhex("010300000002") + crc16(bytes.fromhex("010300000002")) == bytes.fromhex(
        "010300000002C40B"
    )


@pytest.mark.authority
def test_kipp_and_zonen_smp() -> None:
    with bus({1: dict(SMP)}, "kind=smp") as (line, device):
        sample = device.read()  # type: ignore[attr-defined]
        assert (sample.ghi_wm2, sample.temperature_c, sample.status) == (
            997.0,
            pytest.approx(24.8),
            "",
        )
        assert sample.raw == "0001 0000 0000 03e5 03e5 0000 00f8 00ea"
        line.units[1] |= {4: 1, 5: 8123, 3: 8}
        sample = device.read()  # type: ignore[attr-defined]
        assert sample.ghi_wm2 == pytest.approx(812.3) and sample.status == "ghi: status_flags=8"
        line.units[1] |= {4: 0xFFFF, 5: 0xFFFF, 3: 0}  # scale -1, value -1
        assert device.read().ghi_wm2 == pytest.approx(-10.0)  # type: ignore[attr-defined]
        line.units[1] |= {4: 7}
        with pytest.raises(DeviceError, match=r"scale factor of 10\^7"):
            device.read()  # type: ignore[attr-defined]
    assert {request[1] for request in line.sent} == {4}, "only reads may ever be sent"


@pytest.mark.authority
def test_hukseflux_sr_five_registers_at_a_time() -> None:
    text = struct.unpack(">8H", b"SR20-D2".ljust(16, b"\0"))
    # Maker's example: registers 1, 31823 are 973.59 W/m2.
    registers = dict.fromkeys(range(100), 0) | {
        2: 1,
        3: 31823,
        6: 2451,
        40: 4711,
        46: 309,
        47: 9491,
    }
    registers |= dict(zip(range(32, 40), text, strict=True)) | floats(41, 14.8)
    with bus({1: registers}, "kind=sr", largest=5) as (line, device):
        sample = device.read()  # type: ignore[attr-defined]
        assert sample.ghi_wm2 == pytest.approx(973.59) and sample.temperature_c == pytest.approx(
            24.51
        )
        info = device.info  # type: ignore[attr-defined]
        assert (info.model, info.serial, info.sensitivity[:4]) == ("SR20-D2", "4711", "14.8")
        assert info.calibration_date == "2026-01-15"
    assert all(struct.unpack(">H", request[4:6])[0] <= 5 for request in line.sent)


@pytest.mark.contract
def test_two_instruments_on_one_bus() -> None:
    with bus({1: dict(SMP), 2: SMP | {5: 120}}, "kind=smp&dhi_unit=2") as (_, device):
        sample = device.read()  # type: ignore[attr-defined]
        assert (sample.ghi_wm2, sample.dhi_wm2, sample.dni_wm2) == (997.0, 120.0, None)
        assert device.info.gives == ("ghi", "dhi")  # type: ignore[attr-defined]


@pytest.mark.authority
def test_apogee_and_eko_floats() -> None:
    with bus({1: floats(0, 812.25)}, "kind=apogee") as (_, device):
        assert device.read().ghi_wm2 == 812.25  # type: ignore[attr-defined]
    model = dict(zip(range(156, 164), struct.unpack(">8H", b"MS-60S".ljust(16)), strict=True))
    eko = {1: 0} | floats(2, 456.5) | model | {180: 309, 181: 9843}
    with bus({42: eko}, "kind=ms60&unit=42") as (line, device):
        assert device.read().ghi_wm2 == 456.5  # type: ignore[attr-defined]
        assert device.info.model == "MS-60S"  # type: ignore[attr-defined]
        line.units[42] |= floats(2, float("nan"))
        with pytest.raises(DeviceError, match="nan W/m2"):
            device.read()  # type: ignore[attr-defined]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda reply: b"", "does not answer; check wiring"),
        (lambda reply: reply[:-1] + bytes([reply[-1] ^ 1]), "unit 1"),
        (lambda reply: reply[:7], "unit 1"),
        (lambda reply: b"\xff" + reply, "unit 1"),
        (lambda reply: bytes([9]) + reply[1:-2] + crc16(bytes([9]) + reply[1:-2]), "unit 1"),
    ],
    ids=["mute", "flipped", "short", "prefix", "other-unit"],
)
def test_faults_on_the_line(fault: Callable[[bytes], bytes], said: str) -> None:
    with bus({1: dict(SMP)}, "kind=smp") as (line, device):
        line.fault = fault
        with pytest.raises(DeviceError, match=said):
            device.read()  # type: ignore[attr-defined]
        line.fault = lambda reply: reply
        assert device.read().ghi_wm2 == 997.0  # type: ignore[attr-defined]


@contextmanager
def tcp_gateway() -> Iterator[tuple[str, Callable[[], None]]]:
    """Run a Modbus TCP server of pymodbus; yield its address and what ends it."""
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def started() -> ModbusTcpServer:
        content = SimData(0, values=list(SMP.values()), datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(1, simdata=[content]), address=("127.0.0.1", 0))
        await server.listen()
        return server

    server = asyncio.run_coroutine_threadsafe(started(), loop).result(10.0)

    def end() -> None:
        asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(10.0)

    port = server.transport.sockets[0].getsockname()[1]
    try:
        yield f"tcp=127.0.0.1:{port}", end
    finally:
        end()
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10.0)
        loop.close()


@pytest.mark.contract
def test_modbus_tcp_is_read_like_rtu_and_its_faults_are_device_errors() -> None:
    with tcp_gateway() as (place, end):
        uri = f"modbus:{place}?kind=smp&timeout=0.3"
        device = open_pyranometer(uri, clock=FastClock(START))
        assert (device.read().ghi_wm2, device.info.port) == (997.0, place)
        with pytest.raises(DeviceError, match="unit 7"):
            open_pyranometer(f"{uri}&unit=7", clock=FastClock(START))
        end()
        with pytest.raises(DeviceError, match="tcp=127"):
            device.read()
        with pytest.raises(DeviceError, match="no connection; check host"):
            open_pyranometer(uri, clock=FastClock(START))
        device.close()


@pytest.mark.contract
def test_unplugged_is_a_device_error() -> None:
    line = Bus({1: dict(SMP)})
    instrument = PtyInstrument(line)
    uri = f"modbus:{instrument.port}?kind=smp&parity=N&timeout=0.15"
    device = open_pyranometer(uri, clock=FastClock(START))
    instrument.unplug()
    with pytest.raises(DeviceError, match="/dev/"):
        device.read()
    device.close()
    with pytest.raises(DeviceError, match="/dev/"):
        open_pyranometer(uri, clock=FastClock(START))


@pytest.mark.contract
@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("modbus:/dev/x?kind=smq", "no instrument 'smq'; expected one of apogee"),
        (
            "modbus:/dev/x?kind=ms60",
            "no unit number, and ms60 has no default; add it to the URI: its unit number is",
        ),
        ("modbus:/dev/x?unit=1", "expected a port and a kind"),
        ("modbus:/dev/x?kind=smp&unit=1&dhi_unit=1", "occurs twice"),
        ("modbus:/dev/x?kind=smp&write=1", "unknown option 'write'"),
        ("modbus:tcp=:502?kind=smp", "no host; expected one like modbus:tcp="),
        ("modbus:/dev/does-not-exist?kind=smp", "/dev/does-not-exist"),
    ],
)
def test_bad_uris(uri: str, said: str) -> None:
    with pytest.raises(DeviceError, match=said):
        open_pyranometer(uri, clock=FastClock(START))


@pytest.mark.contract
def test_profiles_are_checked(tmp_path: Path) -> None:
    for kind in ("smp", "sr", "sr-pv", "apogee", "ms60", "ms80m"):
        assert load_register_profile(kind).kind == kind
    own = tmp_path / "own.toml"
    head = 'kind = "own"\nmaker = "me"\nmodels = ["1"]\nsource = "s"\n'
    own.write_text(head + "poll = [{ start = 0, count = 200 }]\nentry = []\n")
    with pytest.raises(InputError, match="200 registers from register 0"):
        load_register_profile(str(own))
    own.write_text(
        head
        + 'poll = [{ start = 0, count = 2 }]\nentry = [{ name = "irradiance_wm2", register = 7 }]\n'
    )
    with pytest.raises(InputError, match=r"are in no \[\[poll\]\] block"):
        load_register_profile(str(own))
    own.write_text(head + "poll = [{ start = 0, count = 2 }]\nentry = []\n")
    with pytest.raises(InputError, match="no entry 'irradiance_wm2'"):
        load_register_profile(str(own))


@pytest.mark.contract
def test_numbers_and_dates_of_registers() -> None:
    assert raw_value("s32", [1, 31823]) == 97359 and raw_value("s16", [0xFFFE]) == -2
    assert raw_value("f32", [0x447A, 0]) == 1000.0
    assert date_text(20260115) == "2026-01-15"
    assert date_text(0) == date_text(20261315) == date_text(float(2**32 - 1)) == ""


PROFILES = [load_register_profile(kind) for kind in ("smp", "sr", "apogee", "ms60")]


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=200)
@given(st.sampled_from(PROFILES), st.binary(min_size=400, max_size=400))
def test_any_registers_give_a_plausible_value_or_a_device_error(
    profile: RegisterProfile, data: bytes
) -> None:
    try:
        found = decode(profile, dict(enumerate(struct.unpack(">200H", data))))
    except DeviceError:
        return
    assert isinstance(found, Decoded) and -200 <= found.values["irradiance_wm2"] <= 4000


@pytest.mark.contract
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("smp", "name irradiance_wm2, register 5, type s16, power10_register 4"),
        ("ascii/arduino-keys", "quantity ghi_wm2, key total, decimals 1"),
    ],
)
def test_info_tells_instrument_profiles(name: str, said: str) -> None:
    from click.testing import CliRunner

    from fieldlum.cli import main
    from fieldlum.optics.profiles import shipped

    done = CliRunner().invoke(
        main, ["info", str(shipped("calibration") / "instruments" / f"{name}.toml")]
    )
    assert done.exit_code == 0 and said in done.output
