"""Parse the text of `--scheduler`, which states where units run."""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from fieldlum.errors import InputError, input_errors

FORMS = "local, processes:N, tcp://HOST:PORT or FILE.json"
DEFAULT_RETRIES = 3  # number of further tries of a unit after its worker was lost; chosen


def _silent(text: str) -> None:
    """Show nothing."""


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Certificate files of a cluster that uses TLS.

    ca: of the authority; certificate, key: this computer's own.
    """

    ca: Path
    certificate: Path
    key: Path


@dataclass(frozen=True, slots=True)
class Scheduler:
    """Where units of work run, and how failures of workers are handled.

    processes: their number on this computer; address: tcp:// or tls:// address of a Dask scheduler.
    unit_limit_s: seconds after which a unit counts as hanging; None derives it from completed
    units. retries: number of further tries of a unit after its worker was lost. say: shows one
    sentence to the user.
    """

    kind: Literal["local", "processes", "cluster"] = "local"
    processes: int = 1
    address: str = ""
    tls: TlsFiles | None = None
    unit_limit_s: float | None = None
    retries: int = DEFAULT_RETRIES
    say: Callable[[str], None] = field(default=_silent, compare=False)


LOCAL = Scheduler()


def in_processes(count: int) -> Scheduler:
    """Return the scheduler for `count` processes here; 1 or less means the current process."""
    return Scheduler("processes", count) if count > 1 else LOCAL


def parse_scheduler(text: str, say: Callable[[str], None] = _silent) -> Scheduler:
    """Return the scheduler that `text` names: local, processes:N (or N), tcp:// or FILE.json.

    Raises InputError for any other text and for a FILE.json that cannot be used. Warns through
    `say` about an address that other computers can reach without TLS.
    """
    if text == "local":
        return Scheduler(say=say)
    if text.startswith("processes:") or text.isdigit():
        count = text.removeprefix("processes:")
        if not count.isdigit() or int(count) < 1:
            raise InputError(
                "--scheduler",
                f"'{text}'",
                "processes:N with N of 1 or more",
                "write, for example, processes:2",
            )
        return Scheduler("processes", int(count), say=say)
    if text.startswith(("tcp://", "tls://")):
        if text.startswith("tls://"):
            raise InputError(
                "--scheduler",
                f"'{text}'",
                "tcp://HOST:PORT or FILE.json",
                "name the certificates in a FILE.json (docs/scale.md)",
            )
        return _cluster(_checked(text, "--scheduler"), None, say)
    if text.endswith(".json"):
        return _from_file(Path(text), say)
    raise InputError("--scheduler", f"'{text}'", FORMS, "correct the text, or omit --scheduler")


def _cluster(address: str, tls: TlsFiles | None, say: Callable[[str], None]) -> Scheduler:
    if tls is None and not is_loopback(address):
        say(
            f"WARNING: {address} has no TLS and is not on this computer: anyone who can "
            "reach that port can run programs on its workers. Use a FILE.json with "
            "certificates (docs/scale.md)."
        )
    return Scheduler("cluster", address=address, tls=tls, say=say)


def is_loopback(address: str) -> bool:
    """Return whether the host of the URL `address` is localhost or a loopback address."""
    host = urlsplit(address).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _checked(address: str, where: str) -> str:
    try:
        parts = urlsplit(address)
        usable = bool(parts.hostname and parts.port) and not (parts.username or parts.password)
    except ValueError:
        usable = False
    if not usable:
        raise InputError(
            where, f"'{address}'", "tcp://HOST:PORT", "write, for example, tcp://127.0.0.1:8786"
        )
    return address


def _from_file(path: Path, say: Callable[[str], None]) -> Scheduler:
    """Read the file of `dask scheduler --scheduler-file`, or one with "address" and "tls"."""
    start = "start one with: dask scheduler --scheduler-file FILE.json"
    again = "let dask scheduler --scheduler-file write the file again"
    with (
        input_errors(path, "a scheduler file", start, OSError),
        input_errors(path, "JSON", again, ValueError),
    ):
        table = json.loads(path.read_text(encoding="utf-8"))
    address = table.get("address") if isinstance(table, dict) else None
    if not isinstance(address, str) or not address.startswith(("tcp://", "tls://")):
        raise InputError(
            path,
            f"address {address!r}",
            'a key "address" with a value that begins with tcp:// or tls://',
            again,
        )
    tls = _tls(path, table.get("tls"))
    if address.startswith("tls://") != (tls is not None):
        finding = f"{address} with{'' if tls else 'out'} a table 'tls'"
        expected = "tls:// with a table tls of the files ca, certificate and key, or tcp:// without"
        remedy = "remove the table or use tls://" if tls else "add the table or use tcp://"
        raise InputError(path, finding, expected, remedy)
    return _cluster(_checked(address, str(path)), tls, say)


def _tls(path: Path, table: Any) -> TlsFiles | None:
    """Return the certificate files; their paths are relative to the folder of FILE.json."""
    if table is None:
        return None
    names = ("ca", "certificate", "key")
    if not isinstance(table, dict) or set(table) != set(names):
        raise InputError(
            path,
            f'the table "tls" is {table!r}',
            "the keys ca, certificate and key, each with the path of a file",
            "correct the table",
        )
    files = [path.parent / str(table[name]) for name in names]
    for file in files:
        if not file.is_file():
            raise InputError(
                file,
                "no such file",
                f"a certificate or key file, as the table tls of {path.name} names it",
                "check the path in the table tls",
            )
    if files[2].stat().st_mode & 0o077:
        raise InputError(
            files[2],
            "a private key that other users can read",
            "a key that only its owner can read",
            "run chmod 600 on it",
        )
    return TlsFiles(*files)
