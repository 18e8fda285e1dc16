"""Define every error that is shown to users, and describe faults of files in their words.

FieldlumError            exit 1   a defect
├── InputError           exit 3   a file or an option cannot be used
├── DeviceError          exit 4   a camera or an instrument did not do what was requested
└── NotEnoughDataError   exit 5   the data were read, but are too few to answer the question

Usage errors (exit 2) are click's own.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path


class FieldlumError(Exception):
    """Base of all errors that are shown as one line, without a traceback.

    exit_code: exit status of the command that the error ends.
    """

    exit_code = 1


class InputError(FieldlumError):
    """An input (a file, an option, a session) that cannot be used.

    Printed as one line: `SOURCE: FOUND; expected EXPECTED; REMEDY`. source: the file or option;
    found: what is wrong; expected: what it should be; remedy: what to do. The last two may be "".
    """

    exit_code = 3

    def __init__(
        self, source: Path | str, found: str, expected: str = "", remedy: str = ""
    ) -> None:
        self.source, self.found, self.expected, self.remedy = source, found, expected, remedy
        parts = [found, f"expected {expected}" if expected else "", remedy]
        super().__init__(f"{source}: " + "; ".join(part for part in parts if part))

    def __reduce__(self) -> tuple[type, tuple[Path | str, str, str, str]]:
        # Workers of a process pool return errors to their parent by pickle.
        return type(self), (self.source, self.found, self.expected, self.remedy)


class DeviceError(FieldlumError):
    """A device that is missing, does not answer, or answers something else than requested."""

    exit_code = 4


class NotEnoughDataError(FieldlumError):
    """Readable input that has too few usable data for an answer."""

    exit_code = 5


class Caution(UserWarning):
    """A warning to the user, which the command line prints as one line."""


class ChangedFileWarning(Caution):
    """A file of a session differs from what fieldlum wrote: edited by hand, or damaged."""


def did_you_mean(text: str, names: Iterable[str]) -> str:
    """Return ``; did you mean 'NAME'?`` for the name that a user may have meant by `text`.

    names: all valid names; the first that begins with `text` is used, else the most similar one.
    Return "" if none is similar (by difflib, with its usual limit).
    """
    from difflib import get_close_matches

    valid = list(names)
    near = [name for name in valid if text and name.startswith(text)]
    near = near or get_close_matches(text, valid, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def require_name(what: str, name: object, names: Sequence[str]) -> None:
    """Raise InputError unless `name` is one of `names`; what: the argument or option."""
    if name not in names:
        remedy = f"correct the value{did_you_mean(str(name), names)}"
        raise InputError(what, f"the value {name!r}", f"one of {', '.join(names)}", remedy)


def install_text(extra: str) -> str:
    """Return a clause on how to install a group of optional packages of pyproject.toml.

    extra: name of the group, such as "gphoto". The clause names the source: fieldlum is not
    published, and another person could own its name in a package index.
    """
    return f"install it in the folder of fieldlum's source with: pip install '.[{extra}]'"


def reason_of(error: BaseException) -> str:
    """Return what an exception reports, in words for a user who does not know Python."""
    if isinstance(error, InputError):
        return error.found
    if isinstance(error, KeyError):
        return f"no entry {error}"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, MemoryError):
        return "more data than the memory of this computer holds"
    return str(error) or type(error).__name__


# Files that are no table, by their first bytes (from the formats' specifications).
_KINDS = {
    **dict.fromkeys((b"CDF", b"\x89HDF"), "a netCDF or HDF5 file"),
    b"PK\x03\x04": "a zip archive or a spreadsheet (xlsx)",
    b"\xd0\xcf\x11\xe0": "a spreadsheet (xls)",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF",
    b"\xff\xd8\xff": "a JPEG picture",
    b"\x89PNG": "a PNG picture",
    b"RIFF": "a WebP picture or a sound",
    # an HEIC picture begins with the length of its first box
    **{bytes([0, 0, 0, n]) + b"ftyphei": "an HEIC picture" for n in range(16, 64, 4)},
    **dict.fromkeys((b"II*\0", b"MM\0*"), "a raw or TIFF picture"),
    b"v/1\x01": "an OpenEXR picture",
    b"#?RADIANCE": "a Radiance picture",
    b"<": "a web page or an XML file",
    b'"TOB': "a binary table of a Campbell logger (TOB)",
    b'"TOACI1"': "a table of a Campbell logger in the form TOACI1",
}


def kind_of(data: bytes) -> str:
    """Return the kind of a file, such as "a PDF", by its first bytes.

    data: from the file's beginning. Return "" for a text and for an unknown kind.
    """
    return next((kind for start, kind in _KINDS.items() if data.startswith(start)), "")


_STDERR = threading.Lock()


@contextmanager
def library_messages(*marks: str) -> Iterator[list[str]]:
    """Find out which faults a C library reports on stderr in a `with` block.

    LibRaw and OpenEXR report damage only there, and continue. marks: texts by which their lines are
    recognised. Yield a list that is empty in the block; when the block ends, it gets one entry for
    each line with a mark: the mark, not the line. The stderr of this process, of all its threads,
    is diverted during the block; lines without a mark are printed after it. A lock lets one thread
    at a time enter such a block; a block within another one would wait for ever.
    """
    messages: list[str] = []
    with _STDERR, tempfile.TemporaryFile() as buffer:
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(buffer.fileno(), 2)
        try:
            yield messages
        finally:
            sys.stderr.flush()
            os.dup2(stderr, 2)
            os.close(stderr)
            buffer.seek(0)
            for line in buffer.read().splitlines(keepends=True):
                # the first mark that the line contains
                if mark := next((mark for mark in marks if mark.encode() in line), ""):
                    messages.append(mark)
                else:
                    os.write(2, line)


@contextmanager
def input_errors(
    source: Path | str, expected: str, remedy: str, *kinds: type[Exception]
) -> Iterator[None]:
    """Turn errors of some kinds in a `with` block into InputError with the same reason.

    source: the file; expected, remedy: texts of the InputError, whose `found` is `reason_of` the
    error; kinds: the errors that are caught.
    """
    try:
        yield
    except kinds as error:
        raise InputError(source, reason_of(error), expected, remedy) from None
