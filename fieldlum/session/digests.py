"""Record the SHA-256 of a result in a neighbour, NAME.sha256, and warn if the file changed since.

The neighbour has the form of `sha256sum`. A file without it is not checked: somebody else wrote it,
or an earlier version.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldlum.core.errors import ChangedFileWarning
from fieldlum.session.writing import replacing, sha256


@contextmanager
def sealed(path: Path) -> Iterator[None]:
    """Write the neighbour of a file that is written within the `with` block.

    An interruption leaves a file without neighbour, which is not checked.
    """
    note = _neighbour(path)
    note.unlink(missing_ok=True)
    yield
    with replacing(note, "w", encoding="utf-8") as file:
        file.write(f"{sha256(path)}  {path.name}\n")


def change_of(path: Path) -> str:
    """Return a sentence if a file differs from what its neighbour records, and warn with it.

    Return "" for an unchanged file and for one without a neighbour. The warning is a
    ChangedFileWarning.
    """
    note = _neighbour(path)
    try:
        recorded = note.read_text(encoding="utf-8", errors="replace").split()
    except OSError:
        return ""
    if recorded[:1] == [sha256(path)]:
        return ""
    text = (
        f"{path}: the content changed after fieldlum wrote it; expected the sha256 in {note.name}; "
        f"if you edited it, delete {note.name}, otherwise write {path.name} again"
    )
    warnings.warn(text, ChangedFileWarning, stacklevel=2)
    return text


def _neighbour(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")
