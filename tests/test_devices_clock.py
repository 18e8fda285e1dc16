"""devices: URIs are strict, and the fast clock behaves like a computer's clocks."""

from datetime import UTC, datetime, timedelta
from typing import Annotated, Literal

import pytest
from faulty_clock import FaultyClock
from msgspec import Meta, Struct

from fieldlum.core.errors import DeviceError
from fieldlum.devices import open_camera, parse_uri
from fieldlum.devices.clock import Clock, FastClock

START = datetime(2027, 3, 20, 15, 0, tzinfo=UTC)


@pytest.mark.contract
def test_fast_clock_sleeps_for_nothing() -> None:
    clock = FastClock(START)
    clock.sleep(3600.0)
    assert clock.now() == START + timedelta(hours=1)
    assert clock.monotonic() == clock.boottime() == 3600.0


@pytest.mark.contract
def test_step_moves_the_wall_only() -> None:
    clock = FaultyClock(START, [(START + timedelta(seconds=10), "step", -3600.0)])
    clock.sleep(20.0)
    assert clock.now() == START + timedelta(seconds=20 - 3600)
    assert clock.true_utc == START + timedelta(seconds=20)
    assert clock.monotonic() == clock.boottime() == 20.0


@pytest.mark.contract
def test_suspend_stops_monotonic_only() -> None:
    clock = FaultyClock(START, [(START + timedelta(seconds=10), "suspend", 1800.0)])
    clock.sleep(20.0)
    assert clock.boottime() == 1820.0 and clock.monotonic() == 20.0
    assert clock.now() == START + timedelta(seconds=1820)


@pytest.mark.contract
def test_real_clock_is_aware_and_moves() -> None:
    clock = Clock()
    before = clock.boottime()
    clock.sleep(0.002)
    assert clock.now().tzinfo is not None and clock.boottime() > before and clock.monotonic() > 0


@pytest.mark.contract
def test_naive_start_is_refused() -> None:
    with pytest.raises(ValueError, match="time zone"):
        FastClock(datetime(2027, 3, 20))  # noqa: DTZ001


@pytest.mark.analytic
def test_uri_parts() -> None:
    uri = parse_uri("serial:/dev/ttyUSB0?kind=spn1&baud=9600")
    assert (uri.scheme, uri.place) == ("serial", "/dev/ttyUSB0")
    assert uri.read(Wanted) == Wanted(kind="spn1", baud=9600)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("office", "not a device URI"),
        ("sim:office?seed", "name=value"),
        ("sim:office?seed=1&seed=2", "occurs twice"),
        ("fax:1", "no camera driver 'fax:'"),
    ],
)
def test_bad_uris_name_themselves(text: str, said: str) -> None:
    with pytest.raises(DeviceError, match=said) as caught:
        open_camera(text, clock=FastClock(START))
    assert text in str(caught.value)


class Wanted(Struct):
    kind: Literal["spn1"] = "spn1"
    baud: int = 0
    seed: Annotated[int, Meta(ge=0, le=9)] = 1
    noise: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0


@pytest.mark.contract
def test_unknown_option_is_named() -> None:
    with pytest.raises(DeviceError, match=r"unknown option 'sede'; did you mean 'seed'\?"):
        parse_uri("sim:office?sede=1").read(Wanted)
    for text, said in (
        ("seed=12", "seed = '12', expected a number <= 9; correct the value"),
        ("seed=one", "seed = 'one', not an integer"),
        ("noise=nan", "noise = 'nan', expected a number"),
        ("noise=inf", "noise = 'inf', expected a number <= 1.0"),
        ("kind=x", "the value 'x'; expected one of spn1"),
    ):
        with pytest.raises(DeviceError, match=said):
            parse_uri(f"sim:office?{text}").read(Wanted)
