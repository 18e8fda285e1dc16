"""Identify what must be equal on every worker.

These are fieldlum, the shipped profiles, and the numeric packages.
"""

from __future__ import annotations

from types import FunctionType
from typing import Any, cast


def software_identity() -> dict[str, str]:
    """Return the versions of fieldlum and of numeric packages, and digests of fieldlum's files.

    All imports are inside: the function is sent to workers by value, so that a worker with an older
    fieldlum can answer too.
    """
    import hashlib
    import sys
    from importlib.metadata import PackageNotFoundError, version
    from importlib.util import find_spec
    from pathlib import Path

    def version_of(name: str) -> str:
        try:
            return version(name)
        except PackageNotFoundError:
            return "none"

    def digest(folder: Path, pattern: str) -> str:
        total = hashlib.sha256()
        for path in sorted(folder.rglob(pattern)):
            total.update(path.relative_to(folder).as_posix().encode() + b"\0")
            total.update(hashlib.sha256(path.read_bytes()).digest())
        return total.hexdigest()[:12]

    names = ("numpy", "scipy", "opencv-contrib-python-headless", "torch", "pvlib")
    facts = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    facts |= {name: version_of(name).split("+")[0] for name in names}
    spec = find_spec("fieldlum")
    if spec is None or spec.origin is None:
        return {"fieldlum": "none", **facts}
    package = Path(spec.origin).parent
    shipped = package / "_shipped" / "calibration"
    profiles = shipped if shipped.is_dir() else package.parent / "calibration"
    return {
        "fieldlum": version_of("fieldlum"),
        "source": digest(package, "*.py"),
        "profiles": digest(profiles, "*.toml"),
        **facts,
    }


def sent_by_value() -> Any:
    """Return `software_identity` as a function that cloudpickle sends with its code."""
    probe = cast(FunctionType, software_identity)
    copy = FunctionType(probe.__code__, {"__builtins__": __builtins__}, "software_identity")
    copy.__module__ = "__main__"
    return copy


def difference(mine: dict[str, str], theirs: dict[str, str]) -> str:
    """Return how a worker's software `theirs` differs from `mine`; "" if it does not."""
    changed = [
        f"{name} {theirs.get(name, 'none')} (here {value})"
        for name, value in mine.items()
        if theirs.get(name) != value
    ]
    return ", ".join(changed)
