"""Read the arrays of an .npz file from elsewhere; a small file cannot fill the memory."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from fieldlum.core.arrays import Array

# Most bytes of a compressed member, which could expand to a huge array. Models of 0.1.0 compress
# their mask of seen pixels: 16 MiB are a mask of 2 900 x 5 800 pixels. Chosen.
MAX_COMPRESSED_BYTES = 16 * 2**20
# What reading a damaged or missing file can raise.
NPZ_ERRORS = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_arrays(path: Path) -> dict[str, Array]:
    """Return the arrays by name, of any shape; nothing is unpickled.

    Raises ValueError for compressed members over 16 MiB, for an unknown array format, for objects,
    for a member whose length is not that of its array, and for values that are not finite; OSError
    or zipfile.BadZipFile for a missing or damaged file.
    """
    with path.open("rb") as file:
        _check_members(file)
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"{name} has values that are not finite")
    return arrays


def _check_members(file: IO[bytes]) -> None:
    """Compare each member's header with the length of its data."""
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            compressed = member.compress_type != zipfile.ZIP_STORED
            if compressed and member.file_size > MAX_COMPRESSED_BYTES:
                raise ValueError(
                    f"{member.filename} is compressed and would fill {member.file_size} bytes; "
                    f"expected at most {MAX_COMPRESSED_BYTES}, or no compression"
                )
            with archive.open(member) as data:
                version = np.lib.format.read_magic(data)
                if version not in _HEADERS:
                    raise ValueError(f"{member.filename} has array format {version}")
                shape, _, dtype = _HEADERS[version](data)
                header = data.tell()
            count = 1  # Python's own integers, so that hostile lengths do not overflow
            for length in shape:
                count *= int(length)
            if dtype.hasobject or count * dtype.itemsize != member.file_size - header:
                raise ValueError(f"{member.filename} is not an array of {shape} {dtype}")
