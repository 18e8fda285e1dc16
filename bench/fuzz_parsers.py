"""Damaged lines against every instrument parser: what is refused, what is read, what slips through.

    python bench/fuzz_parsers.py [--lines 13000] [--seed 1] [--only NAME]

Hypothesis makes a complete line of each kind and damages it: cuts it, loses, adds or changes bytes,
joins two halves, or puts noise in its place. Prints a Markdown table. Exits with 1 when a parser
raised something else than the tool's own errors, refused a complete line, or read another number
under a CRC. (The exclusive or of one byte misses one in 256 of the damages to several bytes: no
parser can do better on such a line.)
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusException

from fieldlum.core.errors import FieldlumError
from fieldlum.devices import ascii_lines, cl200a, logger_files, spn1
from fieldlum.devices import modbus as modbus_driver

WATTS, CELSIUS = st.integers(0, 14000), st.integers(-300, 600)  # tenths


class Parser(NamedTuple):
    name: str
    check: str  # what guards a line: "" when nothing but its form does
    lines: st.SearchStrategy[bytes]
    read: Callable[[bytes], Any]


class _Reply:
    """A port that answers each question with `answer`."""

    is_open = True

    def __init__(self) -> None:
        self.answer = self._left = b""

    @property
    def in_waiting(self) -> int:
        return len(self._left)

    def write(self, data: bytes) -> int:
        self._left = self.answer
        return len(data)

    def read(self, size: int) -> bytes:
        data, self._left = self._left[:size], self._left[size:]
        return data


def modbus() -> Parser:
    profile, port = modbus_driver.load_register_profile("smp"), _Reply()
    client = ModbusSerialClient("none", timeout=0.005, retries=0)
    client.socket = port

    def line(tenths: int, warm: int, status: int) -> bytes:
        words = [1, status, 1, tenths, tenths, 0, warm & 0xFFFF, 234]
        body = bytes([1, 4, 16]) + b"".join(w.to_bytes(2, "big") for w in words)
        return body + ascii_lines.crc16(body).to_bytes(2, "little")

    def read(data: bytes) -> Any:
        port.answer = data
        try:
            answer = client.read_input_registers(2, count=8, device_id=1)
        except (ModbusException, OSError) as error:
            raise FieldlumError(str(error)) from None  # as the driver turns it into a DeviceError
        if answer.isError() or len(answer.registers) != 8:
            raise FieldlumError(str(answer))
        return modbus_driver.decode(profile, dict(enumerate(answer.registers, start=2)))

    return Parser("Modbus RTU (SMP)", "CRC-16", st.builds(line, WATTS, CELSIUS, st.just(0)), read)


def nmea(body: str) -> bytes:
    total = 0
    for character in body.removeprefix("$"):
        total ^= ord(character)
    return f"{body}*{total:02X}\r\n".encode()


def with_crc16(body: str) -> bytes:
    return f"{body}*{ascii_lines.crc16(body.removeprefix('$').encode()):04X}\r\n".encode()


# Lines of one's own, with all that can be stated of them.
FIXED = ascii_lines.AsciiProfile(
    "fixed",
    "regex",
    (
        ascii_lines.AsciiField("ghi_wm2", "G", decimals=1, lowest=-10.0, highest=1600.0),
        ascii_lines.AsciiField("temperature_c", "T", decimals=1),
    ),
    pattern=r"G=(?P<G>[ \d.+-]{6}) T=(?P<T>[ \d.+-]{5})",
)


TOA5_HEAD = (
    b'"TOA5","Roof","CR1000X","12345","OS","prog","9","T"\r\n"TIMESTAMP","RECORD","GHI_Avg","DHI_Avg","PTemp_C"\r\n'
    b'"TS","RN","W/m^2","W/m^2","Deg C"\r\n"","","Avg","Avg","Smp"\r\n'
)


def _toa5_row(data: bytes) -> Any:
    text = (TOA5_HEAD + data).decode("utf-8", "replace")
    path, offset = Path("a.dat"), timedelta(hours=-8)
    table = logger_files.text_table(path, text)
    content = logger_files.read_rows(path, table, offset, {}, {})
    if len(content.samples) != 1 or content.left_out:
        raise FieldlumError("left out")
    return content.samples


def parsers() -> list[Parser]:
    names = ("arduino-keys", "arduino-crc", "millivolts", "arduino-json")
    keys, crc, words, js = (ascii_lines.load_ascii_profile(name) for name in names)

    def body(v: tuple[int, int, int]) -> str:
        return f"$G={v[0] / 10:.1f} D={v[1] / 10:.1f} T={v[2] / 10:.1f}"

    tenths = st.tuples(WATTS, WATTS, CELSIUS)
    return [
        Parser(
            "SPN1 reading",
            "",
            st.builds(lambda a, b: b"S%6.1f,%6.1f,1\r" % (a / 10, b / 10), WATTS, WATTS),
            spn1.parse_reading,
        ),
        Parser(
            "SPN1 status",
            "",
            st.builds(lambda n: b"SPN1 v1.03 Mar 13 2007\rUnits: W.m-2\rA%d\r" % n, WATTS),
            spn1.parse_status,
        ),
        modbus(),
        Parser(
            "ASCII pattern",
            "XOR",
            tenths.map(lambda v: nmea(body(v))),
            lambda d: ascii_lines.parse_line(keys, d),
        ),
        Parser(
            "ASCII pattern, CRC",
            "CRC-16",
            tenths.map(lambda v: with_crc16(body(v))),
            lambda d: ascii_lines.parse_line(crc, d),
        ),
        Parser(
            "ASCII key=value",
            "",
            st.integers(0, 20000).map(lambda v: b"G_mV=%.3f\n" % (v / 1000)),
            lambda d: ascii_lines.parse_line(words, d),
        ),
        Parser(
            "ASCII key=value, all stated",
            "",
            tenths.map(lambda v: b"G=%06.1f T=%05.1f\n" % (v[0] / 10, v[2] / 10)),
            lambda d: ascii_lines.parse_line(FIXED, d),
        ),
        Parser(
            "ASCII JSON",
            "",
            tenths.map(lambda v: json.dumps({"G": v[0] / 10, "T": v[2] / 10}).encode() + b"\n"),
            lambda d: ascii_lines.parse_line(js, d),
        ),
        Parser(
            "TOA5 row",
            "",
            tenths.map(
                lambda v: b'"2027-03-20 08:00:00",100,%.1f,%.1f,%.1f\r\n' % tuple(x / 10 for x in v)
            ),
            _toa5_row,
        ),
        Parser(
            "CL-200A",
            "XOR",
            st.integers(100, 9999).map(lambda v: cl200a.frame(b"0002    +%04d4+33300+33400" % v)),
            cl200a.parse_answer,
        ),
        Parser(
            "T-10A",
            "XOR",
            st.integers(100, 9999).map(lambda v: cl200a.frame(b"03100 30+%04d4            " % v)),
            lambda d: cl200a.parse_t10_answer(d, 3),
        ),
    ]


@st.composite
def damaged(draw: Any, lines: st.SearchStrategy[bytes]) -> tuple[str, bytes, bytes]:
    """Kind of damage, the complete line, the line as received."""
    line = draw(lines)
    kind = draw(st.sampled_from(["whole", "cut", "lost", "added", "changed", "joined", "noise"]))
    at, size = draw(st.integers(0, len(line) - 1)), draw(st.integers(1, 3))
    if kind == "cut":
        return kind, line, line[:at]
    if kind == "lost":
        return kind, line, line[:at] + line[at + size :]
    if kind == "added":
        return kind, line, line[:at] + draw(st.binary(min_size=1, max_size=3)) + line[at:]
    if kind == "changed":
        return kind, line, line[:at] + draw(st.binary(min_size=1, max_size=1)) + line[at + 1 :]
    if kind == "joined":
        other = draw(lines)
        came = line[: max(at, 1)] + other[draw(st.integers(1, len(line) - 1)) :]
        return kind, other if came == other else line, came
    return kind, line, line if kind == "whole" else draw(st.binary(max_size=60))


def fuzz(parser: Parser, lines: int, number: int) -> Counter[str]:
    found: Counter[str] = Counter()

    @seed(number)
    @settings(
        max_examples=lines,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(damaged(parser.lines))
    def one(case: tuple[str, bytes, bytes]) -> None:
        kind, line, came = case
        kind = "whole" if came == line else kind
        found["whole" if kind == "whole" else "damaged"] += 1
        try:
            value = parser.read(came)
        except FieldlumError:
            found["whole refused" if kind == "whole" else "refused"] += 1
            return
        except Exception as error:  # what this script looks for
            found["other exceptions"] += 1
            print(f"{parser.name}: {type(error).__name__} {error} of {came!r}", file=sys.stderr)
            return
        if kind != "whole":
            same = value == parser.read(line)
            found["read the same" if same else "read otherwise"] += 1
            found[f"by {kind}"] += not same

    one()
    return found


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--lines", type=int, default=13_000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", default="", help="parsers whose name holds this text")
    options = asked.parse_args()
    start, total, bad = time.monotonic(), 0, False
    print(
        "| parser | guard | complete | refused | damaged | refused | read the same "
        "| read otherwise | other exceptions |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for parser in (p for p in parsers() if options.only in p.name):
        f = fuzz(parser, options.lines, options.seed)
        total += f["whole"] + f["damaged"]
        bad |= bool(
            f["whole refused"]
            or f["other exceptions"]
            or (parser.check == "CRC-16" and f["read otherwise"])
        )
        by = ", ".join(
            f"{kind[3:]} {f[kind]}" for kind in sorted(f) if kind.startswith("by ") and f[kind]
        )
        names = ("whole", "whole refused", "damaged", "refused", "read the same")
        row = [parser.name, parser.check or "form only", *(str(f[name]) for name in names)]
        row += [f"{f['read otherwise']} ({by})" if by else "0", str(f["other exceptions"])]
        print("| " + " | ".join(row) + " |", flush=True)
    print(f"\n{total} lines, seed {options.seed}, {time.monotonic() - start:.0f} s")
    sys.exit(int(bad))


if __name__ == "__main__":
    main()
