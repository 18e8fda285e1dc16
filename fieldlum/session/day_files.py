"""Read and write irradiance/2027-03-20.csv: one file for each UTC day, appended row by row."""

import csv
import io
import math
import os
import zlib
from datetime import UTC
from pathlib import Path

from fieldlum.core import files
from fieldlum.core.errors import InputError
from fieldlum.core.records import IrradianceSample, parse_utc, utc_text
from fieldlum.session.folder import Session
from fieldlum.session.safe_paths import open_inside, refuse_link

QUANTITIES = ("ghi_wm2", "dhi_wm2", "dni_wm2", "temperature_c")
DAY_COLUMNS = ("t_utc", *QUANTITIES, "status", "raw", "crc")
_DAY_HEADER = (",".join(DAY_COLUMNS) + "\n").encode()


def encode_sample(sample: IrradianceSample) -> bytes:
    """Return one row of a day file, the cells of `DAY_COLUMNS`, with its line feed.

    Its last column is the CRC-32 of the columns before it. A number that is None or not finite
    becomes an empty cell.
    """
    numbers = [getattr(sample, name) for name in QUANTITIES]
    cells = ["" if n is None or not math.isfinite(n) else f"{n:.7g}" for n in numbers]
    texts = (sample.status, sample.raw)
    cells += [text.encode("unicode_escape", "backslashreplace").decode() for text in texts]
    row = io.StringIO()
    csv.writer(row, lineterminator="").writerow([utc_text(sample.t_utc), *cells])
    body = row.getvalue().encode()
    return body + b",%08x\n" % zlib.crc32(body)


def decode_sample(line: bytes) -> IrradianceSample | None:
    """Return the sample in a complete and undamaged row; None for any other row."""
    body, _, crc = line.rstrip(b"\r\n").rpartition(b",")  # Windows' line ends change no number
    try:
        if not line.endswith(b"\n") or len(crc) != 8 or int(crc, 16) != zlib.crc32(body):
            return None
        t_utc, *cells, status, raw = next(csv.reader([body.decode()]))
        pairs = zip(QUANTITIES, cells, strict=True)
        values = {name: float(cell) if cell else None for name, cell in pairs}
        return IrradianceSample(parse_utc(t_utc), **values, status=status, raw=raw)
    except (ValueError, StopIteration):
        return None


class DayFiles:
    """Appends samples to irradiance/YYYY-MM-DD.csv, one file for each UTC day.

    cut_bytes: size of the incomplete last lines that were moved out of the files when they were
    opened.
    """

    def __init__(self, session: Session, *, flush: bool = True) -> None:
        """Create the folder irradiance/; flush: whether rows are on the disk after `append`.

        Raises InputError if the folder is a link that the user did not permit.
        """
        self._root, self._folder, self._flush = session.root, session.irradiance, flush
        self._day, self._handle = "", -1
        self.cut_bytes = 0
        refuse_link(self._root, self._folder)
        self._folder.mkdir(parents=True, exist_ok=True)

    def append(self, sample: IrradianceSample) -> None:
        """Append a reading to the file of its UTC day, which is created if it is missing.

        Raises OSError, for example on a full disk, after removing a partly written row.
        """
        day = sample.t_utc.astimezone(UTC).strftime("%Y-%m-%d")
        if day != self._day or files.is_replaced(self._handle, self._folder / f"{day}.csv"):
            self._open(day)
        files.append_complete(self._handle, encode_sample(sample), flush=self._flush)

    def _open(self, day: str) -> None:
        """Open the file of a UTC day to append to it; move an incomplete last line away."""
        self.close()
        path = self._folder / f"{day}.csv"
        is_spoilt = False
        files.break_hard_links(path)
        try:
            self.cut_bytes += files.cut_torn_tail(
                path, lambda line: line == _DAY_HEADER or decode_sample(line) is not None
            )
        # Somebody saved the file with a spreadsheet: append a header and new rows to it; readers
        # count the lines above as damaged.
        except InputError:
            is_spoilt = True
        handle = open_inside(self._root, path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        try:
            if is_spoilt or os.fstat(handle).st_size == 0:
                files.append_complete(handle, b"\n" * is_spoilt + _DAY_HEADER, flush=self._flush)
                if self._flush:
                    files.sync_folder(self._folder)
        except OSError:
            os.close(handle)
            raise
        self._day, self._handle = day, handle

    def close(self) -> None:
        """Close the current day's file."""
        if self._handle >= 0:
            os.close(self._handle)
        self._day, self._handle = "", -1


def day_files(session: Session) -> list[Path]:
    """Return the files irradiance/YYYY-MM-DD.csv of a session, in order of time."""
    return sorted(session.irradiance.glob("[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9].csv"))


def read_day(path: Path) -> tuple[list[IrradianceSample], int]:
    """Return the samples of one day file, in its order, and the number of damaged lines skipped.

    Raises OSError if the file cannot be read.
    """
    samples: list[IrradianceSample] = []
    damaged = 0
    with files.open_to_read(path) as file:
        for line in file:
            sample = decode_sample(line)
            if sample is not None:
                samples.append(sample)
            elif line.removeprefix(b"\xef\xbb\xbf").rstrip() != _DAY_HEADER.rstrip():
                damaged += 1
    return samples, damaged
