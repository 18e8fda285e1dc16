"""Write and read scene.toml: the result of a fit, and the chosen geometry."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fieldlum.core.errors import InputError
from fieldlum.core.records import Room
from fieldlum.core.strict_toml import build, plain, read_toml
from fieldlum.session import write_file

SCENE_TOML = "scene.toml"
FORMAT = 1
Chosen = Literal["none", "stated", "fitted"]


@dataclass(frozen=True, slots=True)
class Scene:
    """A fitted scene as `train` uses it.

    room: the fitted box relative to true north. north_deg: how far room and camera are turned
    clockwise from the stated direction; clock_min: stated time minus true time. before, after, u:
    stated and fitted values and standard uncertainties, by `Parameter.name`, in the parameter's
    unit. hours: number of sunny hours of the fit. misfit: for the geometries "none", "stated" and
    "fitted", the share of pixels, 0 to 1, that are wrong with it in the sunny hours. chosen: the
    geometry that the captures support; verdict: why; trusted: whether enough hours support it.
    stated_heading_deg, stated_room: the start of the fit, as the captures stated it. A scene is
    used only with captures that state the same, otherwise a correction would be applied twice.
    notes: sentences for the user. format: of scene.toml.
    """

    north_deg: float
    clock_min: float
    room: Room
    chosen: Chosen
    verdict: str
    stated_heading_deg: float
    stated_room: Room
    trusted: bool = True
    hours: int = 0
    misfit: dict[str, float] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    u: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    format: int = FORMAT


def write_scene(folder: Path, scene: Scene) -> Path:
    """Write scene.toml into a folder, which is created, and return the file's path.

    An existing file is replaced.
    """
    import tomli_w

    return write_file(folder / SCENE_TOML, tomli_w.dumps(plain(scene)))


def read_scene(folder: Path) -> Scene:
    """Read the scene.toml of a folder.

    Raises InputError if it is missing, not valid TOML, of another format number, or has missing,
    unknown or wrong entries.
    """
    path = folder / SCENE_TOML
    if not path.is_file():
        remedy = "write one with: fieldlum scene fit SESSION --out DIR"
        raise InputError(path, "no such file", "a fitted scene", remedy)
    table = read_toml(path)
    if table.get("format") != FORMAT:
        expected, remedy = f"format {FORMAT}", "fit the scene again (fieldlum scene fit)"
        raise InputError(path, f"a scene of format {table.get('format')}", expected, remedy)
    for name in ("room_draws", "expected_log10_mse", "trusted_share"):  # of earlier versions
        table.pop(name, None)
    return build(Scene, table, str(path))
