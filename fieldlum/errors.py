"""Every error a user can meet.

FieldlumError            exit 1   a defect
├── InputError           exit 3   a file says something that cannot be used
├── DeviceError          exit 4   a camera or an instrument did not do what was asked
└── NotEnoughDataError   exit 5   the data were read, but do not answer the question

Usage errors (exit 2) are click's own.
"""

from pathlib import Path


class FieldlumError(Exception):
    """Base of all errors that are shown as one line, without a traceback."""

    exit_code = 1


class InputError(FieldlumError):
    """A bad input file: names the file, what was found, what was expected, and what to do."""

    exit_code = 3

    def __init__(
        self, source: Path | str, found: str, expected: str = "", remedy: str = ""
    ) -> None:
        self.source, self.found, self.expected, self.remedy = source, found, expected, remedy
        said = [found, f"expected {expected}" if expected else "", remedy]
        super().__init__(f"{source}: " + ", ".join(part for part in said if part))

    def __reduce__(self) -> tuple[type, tuple[Path | str, str, str, str]]:
        # Workers of a process pool send errors home by pickle.
        return type(self), (self.source, self.found, self.expected, self.remedy)


class DeviceError(FieldlumError):
    """A device that is missing, silent, or answers with something else than asked."""

    exit_code = 4


class NotEnoughDataError(FieldlumError):
    """Too little usable data to answer."""

    exit_code = 5
