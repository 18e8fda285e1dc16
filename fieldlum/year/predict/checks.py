"""Check, before predicting, whether model and session match and whether the year exists."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.optics.images import read_panorama
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.session import open_session, sha256
from fieldlum.session.files.model_config import UsedScene
from fieldlum.session.provenance import made_from
from fieldlum.session.site_toml import site_table
from fieldlum.sky.sky_view.view import NAME as SKY_VIEW
from fieldlum.version import __version__
from fieldlum.weather import SYNTHETIC
from fieldlum.year.predict.annual import Annual, read_annual
from fieldlum.year.predict.blocks import ModelRoom
from fieldlum.year.predict.maps import is_complete
from fieldlum.year.predict.occupancy import Occupancy


def default_folder(model_folder: Path) -> Path:
    """Return where a model's predicted year is stored by default.

    This is SESSION/annual/NAME for a model in SESSION/models/NAME, else `annual` in the model's
    folder.
    """
    if session_folder(model_folder) is None:
        return model_folder / "annual"
    return model_folder.parent.parent / "annual" / model_folder.resolve().name


def session_folder(model_folder: Path) -> Path | None:
    """Return the session that a model folder is in; None if it is elsewhere."""
    models = model_folder.resolve().parent
    in_session = models.name == "models" and (models.parent / "session.toml").is_file()
    return models.parent if in_session else None


def check_session(model_folder: Path, room: ModelRoom, scene: UsedScene | None = None) -> None:
    """Raise InputError if a model was trained for another place, camera, room or picture format.

    It is compared with the session whose folder `models` contains it; a model elsewhere is not
    checked. The place may differ by 0.01 degrees, the heading of the first panorama by 0.1 degrees;
    its size in pixels must be equal. scene: the fitted scene in the model's config.json, if any;
    then the room and heading as stated before the fit are compared.
    """
    root = session_folder(model_folder)
    if root is None:
        return
    session = open_session(root)
    setup = session.site_file()
    mine, theirs = room.setup.site, setup.site
    own, other = (np.array([site.latitude_deg, site.longitude_deg]) for site in (mine, theirs))
    if np.abs(own - other).max() > 0.01:
        found, expected = (
            f"{s.name} ({s.latitude_deg:g}, {s.longitude_deg:g} deg)" for s in (mine, theirs)
        )
        _refuse(model_folder, f"of the site {found}", expected)
    stated = scene["stated"] if scene else site_table(room.setup)
    for table in ("camera", "room"):  # both affect every map
        own, other = stated.get(table) or {}, site_table(setup).get(table) or {}
        for name in sorted({*own, *other} - {"profile"}):
            if own.get(name) != other.get(name):
                found = f"with [{table}] {name} = {own.get(name, 'none')}"
                _refuse(model_folder, found, str(other.get(name, "none")))
    heading_deg = float(scene["stated_heading_deg"]) if scene else room.heading_deg
    for path in session.panorama_files()[:1]:
        first = read_panorama(path)
        height, width = first.luminance_cdm2.shape
        if (height, width) != (room.height, room.width):
            found = f"with pictures of {room.width} x {room.height} pixels"
            _refuse(model_folder, found, f"{width} x {height} pixels")
        if abs(signed_angle_deg(first.heading_deg - heading_deg)) > 0.1:
            found = f"with a heading of {heading_deg:g} deg"
            _refuse(model_folder, found, f"{first.heading_deg:g} deg")


def _refuse(model_folder: Path, found: str, expected: str) -> NoReturn:
    raise InputError(
        model_folder,
        f"a model {found}",
        f"{expected}, as in this session",
        "merge, pair and train again, or use the model that was trained on this session",
    )


def inputs_of(
    model: Path,
    weather: Path,
    views: int,
    occupancy: Occupancy,
    maps: bool,
    seed: int,
    label_shift_min: float = 0.0,
) -> dict[str, object]:
    """Return what a predicted year depends on, as plain values: options and digests of the files.

    model: its folder; weather: a file, or "synthetic"; views: number of view directions. Lamps and
    the URL of maps are not included. Raises InputError for a missing weather file.
    """
    synthetic = str(weather) == SYNTHETIC
    if not synthetic and not weather.is_file():
        expected = "a weather file, or the word synthetic"
        raise InputError(weather, "no such file", expected, "check the path")
    weights, view = model / "weights.npz", model / SKY_VIEW
    return {
        "model": model.resolve().name,
        "model_sha256": sha256(model / "config.json"),
        "weights_sha256": sha256(weights) if weights.is_file() else "",
        "sky_view_sha256": sha256(view) if view.is_file() else "",
        "weather": weather.name,
        "weather_sha256": "" if synthetic else sha256(weather),
        **({"label_shift_min": label_shift_min} if label_shift_min else {}),
        "views": views,
        "occupancy": occupancy.text,
        "maps": maps,
        "seed": seed,
    }


def already(folder: Path, inputs: Mapping[str, object]) -> Annual | None:
    """Return the year in `folder` if the same version computed it from the same inputs, else None.

    inputs: the result of `inputs_of`, and `lamps` and `maps_to` if used. A damaged year counts as
    missing. A stored year with maps is also returned to a request without maps.
    """
    note, maps = folder / "predict.json", folder / "maps.zarr"
    more = [] if inputs["maps"] else [{**inputs, "maps": True}]
    tables = (made_from(note, wanted, [folder / "hourly.csv"]) for wanted in (inputs, *more))
    table = next((candidate for candidate in tables if candidate is not None), None)
    if table is None or table.get("software", {}).get("fieldlum") != __version__:
        return None
    if inputs["maps"] and not maps.is_dir():
        return None
    bucket = inputs.get("maps_to")
    if isinstance(bucket, str) and not is_complete(bucket, inputs):
        return None
    try:
        return read_annual(folder)
    except InputError:
        return None


def delete_earlier_year(folder: Path) -> None:
    """Delete predict.json and maps.zarr, if any, so that `folder` no longer holds a complete year.

    Otherwise an interruption could leave the hours of one weather file with the classes of another.
    """
    (folder / "predict.json").unlink(missing_ok=True)
    for name in ("maps.zarr", ".maps.zarr.tmp"):
        shutil.rmtree(folder / name, ignore_errors=True)
