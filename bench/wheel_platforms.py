"""Print for which systems every dependency of fieldlum offers a wheel, without downloading any.

python bench/wheel_platforms.py [--python 3.11] [--extra gphoto] ...

Asks pip's index for each distribution of the dependency tree; needs the network. The tree is
walked in the environment that runs this, with the markers of the other system.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

# glibc versions that a wheel may state (PEP 600), up to that of Debian 12 and Ubuntu 22.04.
_GLIBC_MINOR_VERSIONS = (5, 12, 17, 24, 26, 27, 28, 31, 34, 35)


@dataclass(frozen=True, slots=True)
class TargetSystem:
    """A system as pip's tags and as markers name it."""

    label: str
    tags: tuple[str, ...]
    sys_platform: str
    platform_system: str
    machine: str


def _linux(machine: str) -> TargetSystem:
    tags = tuple(f"manylinux_2_{minor}_{machine}" for minor in _GLIBC_MINOR_VERSIONS)
    tags = (*tags, f"manylinux2014_{machine}")
    return TargetSystem(f"Linux {machine}", tags, "linux", "Linux", machine)


SYSTEMS = (
    _linux("x86_64"),
    _linux("aarch64"),
    TargetSystem("macOS arm64", ("macosx_14_0_arm64",), "darwin", "Darwin", "arm64"),
    TargetSystem("Windows amd64", ("win_amd64",), "win32", "Windows", "AMD64"),
)


def dependency_tree(system: TargetSystem, python: str, extras: tuple[str, ...]) -> dict[str, str]:
    """Return distribution names and what is required of each, on a system.

    A distribution that is not installed here is included, its own requirements are not.
    """
    environment = {
        "sys_platform": system.sys_platform,
        "platform_system": system.platform_system,
        "platform_machine": system.machine,
        "os_name": "nt" if system.sys_platform == "win32" else "posix",
        "python_version": python,
        "python_full_version": f"{python}.0",
    }
    tree: dict[str, str] = {}
    waiting = [("fieldlum", extra) for extra in ("", *extras)]
    while waiting:
        name, extra = waiting.pop()
        try:
            requires = distribution(name).requires or []
        except PackageNotFoundError:
            continue
        for line in requires:
            requirement = Requirement(line)
            applies = requirement.marker is None or requirement.marker.evaluate(
                environment | {"extra": extra}
            )
            if not applies:
                continue
            key = canonicalize_name(requirement.name)
            if key not in tree:
                waiting += [(key, own) for own in ("", *requirement.extras)]
            tree[key] = f"{requirement.name}{requirement.specifier}"
    return tree


def without_wheel(system: TargetSystem, python: str, requirements: list[str]) -> list[str]:
    """Return those requirements for which the index offers no wheel."""
    missing: list[str] = []
    left = list(requirements)
    while left:
        error = _resolve(system, python, left)
        if error is None:
            return missing
        named = re.search(r"No matching distribution found for ([A-Za-z0-9._-]+)", error)
        if named is None:
            raise SystemExit(f"pip: {error.strip()[-500:]}")
        name = canonicalize_name(re.split(r"[<>=!~]", named[1])[0])
        missing.append(name)
        left = [r for r in left if canonicalize_name(Requirement(r).name) != name]
    return missing


def _resolve(system: TargetSystem, python: str, requirements: list[str]) -> str | None:
    """Ask pip for wheels of all requirements; return its error, or None."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet"]
        command += ["--ignore-installed", "--no-deps", "--only-binary=:all:"]
        command += ["--python-version", python, "--report", str(report)]
        command += [part for tag in system.tags for part in ("--platform", tag)]
        ran = subprocess.run([*command, *requirements], text=True, capture_output=True)
        if ran.returncode:
            return ran.stderr
        resolved = json.loads(report.read_text())["install"]
        assert len(resolved) == len(requirements)
        return None


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default="3.11")
    parser.add_argument("--extra", action="append", default=[])
    options = parser.parse_args()
    print("| system | distributions | without a wheel |")
    print("|---|---|---|")
    for system in SYSTEMS:
        tree = dependency_tree(system, options.python, tuple(options.extra))
        missing = without_wheel(system, options.python, sorted(tree.values()))
        print(f"| {system.label} | {len(tree)} | {', '.join(missing) or 'none'} |", flush=True)


if __name__ == "__main__":
    main()
