"""Parse the text of `--scheduler`, which states where units run."""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from fieldlum.core.errors import InputError, input_errors

FORMS = "local, processes:N, tcp://HOST:PORT or FILE.json"
DEFAULT_RETRIES = 3  # number of further tries of a unit after its worker was lost; chosen


def _silent(text: str) -> None:
    """Show nothing."""


@dataclass(frozen=True, slots=True)
class Scheduler:
    """Where units of work run, and how failures of workers are handled.

    processes: their number on this computer; address: tcp:// or tls:// address of a Dask scheduler.
    tls: certificate files by Dask's names (tls_ca_file, tls_client_cert, tls_client_key), empty
    without TLS. unit_limit_s: seconds after which a unit counts as hanging; None derives it from
    completed units. retries: number of further tries of a unit after its worker was lost. say:
    shows one sentence to the user.
    """

    kind: Literal["local", "processes", "cluster"] = "local"
    processes: int = 1
    address: str = ""
    tls: tuple[tuple[str, str], ...] = ()
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
    count = text.removeprefix("processes:")
    if text == "local":
        return Scheduler(say=say)
    if count.isdigit() and int(count) > 0:
        return Scheduler("processes", int(count), say=say)
    if text.startswith("tcp://"):
        return _cluster(text, (), "--scheduler", say)
    if text.endswith(".json"):
        path = Path(text)
        table = _table(path)
        return _cluster(str(table.get("address")), _tls(path, table.get("tls")), path, say)
    remedy = "correct the text, or omit --scheduler; TLS needs a FILE.json (docs/scale.md)"
    raise InputError("--scheduler", f"'{text}'", FORMS, remedy)


def _cluster(
    address: str,
    tls: tuple[tuple[str, str], ...],
    where: str | Path,
    say: Callable[[str], None],
) -> Scheduler:
    scheme = "tls" if tls else "tcp"
    try:
        parts = urlsplit(address)
        usable = parts.scheme == scheme and bool(parts.hostname and parts.port)
    except ValueError:
        parts, usable = urlsplit(""), False
    if not usable or parts.username or parts.password:
        remedy = "write, for example, tcp://127.0.0.1:8786; tls:// needs a table tls in a FILE.json"
        raise InputError(where, f"the address '{address}'", f"{scheme}://HOST:PORT", remedy)
    if not tls and not is_loopback(parts.hostname or ""):
        say(
            f"WARNING: {address} has no TLS and is not on this computer: anyone who can "
            "reach that port can run programs on its workers. Use a FILE.json with "
            "certificates (docs/scale.md)."
        )
    return Scheduler("cluster", address=address, tls=tls, say=say)


def is_loopback(host: str) -> bool:
    """Return whether a host is localhost or a loopback address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _table(path: Path) -> dict[str, Any]:
    """Read the file of `dask scheduler --scheduler-file`, or one with "address" and "tls"."""
    remedy = "let dask scheduler --scheduler-file write the file"
    with input_errors(path, "a JSON file of a scheduler", remedy, OSError, ValueError):
        table = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(table, dict):
        raise InputError(path, "no JSON object", 'a key "address"', remedy)
    return table


def _tls(path: Path, table: Any) -> tuple[tuple[str, str], ...]:
    """Return the certificate files; their paths are relative to the folder of FILE.json."""
    if table is None:
        return ()
    names = {"ca": "tls_ca_file", "certificate": "tls_client_cert", "key": "tls_client_key"}
    if not isinstance(table, dict) or table.keys() != names.keys():
        expected = "the keys ca, certificate and key, each with the path of a file"
        raise InputError(path, f'the table "tls" is {table!r}', expected, "correct the table")
    files = {name: path.parent / str(table[name]) for name in names}
    for file in files.values():
        if not file.is_file():
            expected = f"a certificate or key file, as the table tls of {path.name} names it"
            raise InputError(file, "no such file", expected, "check the path in the table tls")
    if files["key"].stat().st_mode & 0o077:
        finding, expected = "a private key that other users can read", "a key for its owner only"
        raise InputError(files["key"], finding, expected, "run chmod 600 on it")
    return tuple((names[name], str(file)) for name, file in files.items())
