"""Read CAMPAIGN.toml: the rooms of a campaign, and the values that they share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.strict_toml import TomlTable, build, read_toml

_EXPECTED = "a table [[room]] with session = FOLDER for each room"


@dataclass(frozen=True, slots=True)
class CampaignRoom:
    """One room of a campaign. Paths are relative to CAMPAIGN.toml.

    A value that is absent or "" is replaced by that of [common], else by that of DEFAULTS, where
    session and site are "" and seed is 0. session: its folder. site and set: from which `plan`
    creates a missing session. model, seed, budget_min [minutes]: for `train`. weather and views
    (number of view directions): for `predict`. size: WIDTHxHEIGHT for `merge`.
    """

    session: str = ""
    site: str = ""
    set: str = ""
    model: str = ""
    seed: int = 0
    budget_min: float = 0.0
    weather: str = ""
    views: int = 0
    size: str = ""


DEFAULTS = CampaignRoom(
    set="9-day", model="auto", budget_min=10.0, views=10, size="460x230", weather="synthetic"
)


@dataclass(frozen=True, slots=True)
class CampaignFile:
    """The content of a CAMPAIGN.toml: its name, and its rooms with the values of [common]."""

    path: Path
    name: str
    rooms: tuple[CampaignRoom, ...]

    def session_folder(self, room: CampaignRoom) -> Path:
        """Return the path of a room's session, resolved from the folder of the campaign file."""
        return self.path.parent / room.session

    def file(self, name: str) -> Path:
        """Return the path `name`, resolved from the folder of the campaign file."""
        return self.path.parent / name


def read_campaign(path: Path) -> CampaignFile:
    """Read a CAMPAIGN.toml; without the key `name` the file's name is used.

    Raises InputError for a missing file or one that is no TOML, for unknown keys or values of a
    wrong type, without a room, for a room without a session, for a session named twice, and unless
    budget_min and views are above 0.
    """
    table = read_toml(path)
    if unknown := table.keys() - {"name", "common", "room"}:
        expected, remedy = "name, [common] and [[room]]", "correct or remove the key"
        raise InputError(path, f"unknown key '{min(unknown)}'", expected, remedy)
    common = _filled(table.get("common", {}), f"{path} [common]", DEFAULTS)
    tables = table.get("room")
    if not isinstance(tables, list) or not tables:
        raise InputError(path, "no [[room]]", _EXPECTED, "add a table [[room]] for each room")
    rooms = tuple(
        _filled(entry, f"{path} [[room]] {k}", common) for k, entry in enumerate(tables, start=1)
    )
    names = [room.session for room in rooms]
    for number, name in enumerate(names, start=1):
        if not name:
            finding, remedy = f"[[room]] {number} has no session", "add session = FOLDER to it"
            raise InputError(path, finding, _EXPECTED, remedy)
        if names.count(name) > 1:
            finding, remedy = f"session {name} occurs twice", "remove one of its [[room]] tables"
            raise InputError(path, finding, "each session once", remedy)
    return CampaignFile(path, str(table.get("name", path.stem)), rooms)


def _filled(table: TomlTable, where: str, common: CampaignRoom) -> CampaignRoom:
    """Return the room of a table, with absent and "" values replaced by those of `common`."""
    stated = build(CampaignRoom, table, where)
    room = replace(common, **{key: getattr(stated, key) for key in table if table[key] != ""})
    for key in ("budget_min", "views"):
        if (value := getattr(room, key)) <= 0:
            raise InputError(where, f"{key} = {value:g}", "a number above 0", "correct it")
    return room
