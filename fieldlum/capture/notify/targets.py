"""Read where messages are sent: addresses for apprise, from a file, never from the command line.

An address contains a password or a token. Therefore it is read from a file or from the environment,
and is never part of an argument, an error, the journal or a session.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

from fieldlum.capture.notify.outbox import Message, Post
from fieldlum.core.errors import InputError, install_text

VARIABLE = "FIELDLUM_NOTIFY"
_READABLE_BY_OTHERS = 0o077  # permission bits of group and others (POSIX)


def read_targets(
    option: str, variable: str = "", *, name: str = "--notify"
) -> tuple[tuple[str, ...], str]:
    """Return the addresses in ``@FILE``, and a note about the file, "" if there is none.

    option: value of the option `name`; if it is empty, `variable`, the content of the environment
    variable, is used, which is ``@FILE`` or addresses separated by blanks; without both there is no
    address. A file has one address per line; empty lines and lines that begin with # are skipped.
    Raises InputError for an option that is not ``@FILE``, and for a file that cannot be read or is
    empty; no error contains an address.
    """
    if not option and variable and not variable.startswith("@"):
        return tuple(variable.split()), ""
    text = option or variable
    if not text:
        return (), ""
    if not text.startswith("@"):
        raise InputError(
            name,
            "an address on the command line, where every user can see it",
            "@FILE",
            f"write the address into a file, and write {name} @FILE",
        )
    path = Path(text[1:])
    lines = _lines(path)
    if not lines:
        raise InputError(
            path,
            "no address in the file",
            "one apprise address per line",
            "write an address into the file",
        )
    return lines, _privacy_note(path)


def _lines(path: Path) -> tuple[str, ...]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(
            path,
            str(why),
            "a UTF-8 file that you may read, with one apprise address per line",
            "check the path after the @, its permissions and its encoding",
        ) from None
    stripped = (line.strip() for line in text.splitlines())
    return tuple(line for line in stripped if line and not line.startswith("#"))


def _privacy_note(path: Path) -> str:
    if os.name != "posix" or not path.stat().st_mode & _READABLE_BY_OTHERS:
        return ""
    return f"{path} can be read by other users: run chmod 600 {path}"


def apprise_post(targets: Sequence[str], source: Path | str = "targets") -> Post:
    """Return a function that sends one message to all targets, and returns whether all succeeded.

    Raises InputError without the package apprise and for a target that it does not understand, with
    the target's number but without its text. source: what states the targets, for errors.
    """
    logging.getLogger("apprise").setLevel(logging.CRITICAL)  # its log lines contain addresses
    try:
        with warnings.catch_warnings():  # one of its services imports a deprecated module
            warnings.simplefilter("ignore", DeprecationWarning)
            import apprise

            sender = apprise.Apprise()
            understood = [sender.add(target) for target in targets]
    except ImportError:
        raise InputError(
            source,
            "messages cannot be sent",
            "the package apprise",
            install_text("notify"),
        ) from None
    if not all(understood):
        number = understood.index(False) + 1
        raise InputError(
            source,
            f"apprise does not understand address {number} of {len(understood)}",
            "an address such as mailto://, ntfy:// or tgram://",
            "see the list of services in apprise's documentation",
        )

    def post(message: Message) -> bool:
        attach = str(message.picture) if message.picture and message.picture.is_file() else None
        return bool(sender.notify(title=message.title, body=message.body, attach=attach))

    return post
