"""`fieldlum info`: describe any file of fieldlum."""

from pathlib import Path
from typing import Any

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import emit_json, say, tell
from fieldlum.core.errors import InputError, did_you_mean, kind_of
from fieldlum.core.files import read_bytes

Facts = dict[str, Any]  # facts about a file by name, as --json prints them


@command_of("info")
def command(files: tuple[Path, ...], part: str = "", json_lines: bool = False) -> None:
    """Describe frames, pictures, plans, profiles or models.

    \b
    Example:
      fieldlum info canon-5d2-8mm-f5.6
      fieldlum info raw/20270320T193000Z/f00.dng panoramas/20270320T193000Z.exr plan.csv

    Options:
      --json: Print one JSON object for each file, one per line.
    """
    unreadable = 0
    for path in files:
        try:
            facts = {"file": str(path), **describe(path, part)}
        except InputError as error:
            say(f"fieldlum info: {error}")
            unreadable += 1
            continue
        if json_lines:
            emit_json(facts)
        else:
            tell(facts.pop("file"))
            for name, value in facts.items():
                is_table = isinstance(value, list) and value and isinstance(value[0], dict)
                for row in value if is_table else [value]:
                    tell(f"  {name:24} {_short(row)}".replace("\n", " "))
    if unreadable:
        raise SystemExit(InputError.exit_code)


def _short(value: Any) -> str:
    """Return a value as text of at most 200 characters and an ellipsis; `--json` prints all of it.

    A table becomes a list of names and values.
    """
    pairs = value.items() if isinstance(value, dict) else ()
    text = ", ".join(f"{name} {shown}" for name, shown in pairs) or str(value)
    return text if len(text) <= 200 else f"{text[:200]} ..."


def describe(path: Path, part: str = "") -> Facts:
    """Return what `fieldlum info` prints about a file or folder, by name, without its path.

    The names depend on the kind of file (docs/cli.md). path: a file, a folder, or the name of a
    shipped camera profile. part: name of the part, layer or stereo view of an .exr; "" for the only
    one. Warn if the file changed after fieldlum wrote it. Raises InputError if it is missing,
    invalid or of an unknown kind, OSError if a csv cannot be read.
    """
    from fieldlum.optics.profiles import camera_names, find_camera_profile
    from fieldlum.optics.raw import RAW_SUFFIXES
    from fieldlum.session.codec import warn_if_changed

    if not path.exists() and str(path) in camera_names():
        path = find_camera_profile(str(path))
    if path.is_dir():
        return _folder(path)
    if not path.exists():
        near = did_you_mean(str(path), camera_names())
        raise InputError(path, "no such file or folder", remedy=f"check the path{near}")
    suffix = path.suffix.lower()
    warn_if_changed(path)
    if suffix == ".exr":
        return _exr(path, part)
    readers = {".hdr": _radiance, ".toml": _toml, ".csv": _csv, ".jpg": _jpeg, ".jpeg": _jpeg}
    readers |= dict.fromkeys(RAW_SUFFIXES, _raw)
    if suffix in readers:
        return readers[suffix](path)
    found = kind_of(read_bytes(path)[:64]) or "a file of an unknown kind"
    expected, remedy = "a frame, .exr, .hdr, profile, csv or folder", "name such a file"
    if suffix in (".epw", ".tm2", ".wea"):
        found, remedy = "a weather file", "read it with: fieldlum predict MODELDIR --weather FILE"
    raise InputError(path, found, expected, remedy)


def _size(picture: Any) -> str:
    """Return "width x height" of an array [h, w, ...], in pixels."""
    return f"{picture.shape[1]} x {picture.shape[0]}"


def _light(luminance_cdm2: Any) -> Facts:
    """Return size, median and largest luminance of a map [h, w]; NaN and infinity do not count."""
    import numpy as np

    values = luminance_cdm2[np.isfinite(luminance_cdm2)]
    median, largest = round(float(np.median(values)), 3), round(float(values.max()), 1)
    return {"size": _size(luminance_cdm2), "median_cdm2": median, "largest_cdm2": largest}


def _exr(path: Path, part: str) -> Facts:
    """Return facts about a panorama, or about a picture and the view that `glare` would use."""
    import numpy as np

    from fieldlum.core.records import utc_text
    from fieldlum.optics.images import read_exr
    from fieldlum.session.panorama_sun import read_panorama_with_sun

    picture, view = read_exr(path, part)
    facts: Facts = {"kind": "EXR picture", "view": view or "missing"}
    if view == "equirect":
        picture = read_panorama_with_sun(path, part=part)
        facts = {"kind": "panorama", "heading_deg": picture.heading_deg}
    if not np.isfinite(picture.luminance_cdm2).any():
        expected, remedy = "a picture with luminances", "merge or convert it again"
        raise InputError(path, "no finite luminance", expected, remedy)
    flagged = 0.0 if picture.flags is None else 100.0 * float((picture.flags > 0).mean())
    time = utc_text(picture.t_utc) if picture.t_utc else ""
    facts |= {"t_utc": time, **_light(picture.luminance_cdm2), "flagged_percent": round(flagged, 2)}
    return {**facts, "sun": str(picture.sun) if picture.sun else "none", **picture.attributes}


def _radiance(path: Path) -> Facts:
    """Return facts about a Radiance picture (.hdr)."""
    from fieldlum.optics.images import read_radiance_hdr

    image, header = read_radiance_hdr(path)
    view = header.view or ("missing" if header.heading_deg is None else "equirect")
    return {"kind": "Radiance picture", "view": view, **_light(image.luminance_cdm2)}


def _toml(path: Path) -> Facts:
    """Return the kind of a TOML file of fieldlum, and its keys with their values.

    Raises InputError for an invalid file, or one of another program.
    """
    from fieldlum.core.strict_toml import build, read_toml
    from fieldlum.devices.ascii_lines import load_ascii_profile
    from fieldlum.devices.modbus import load_register_profile
    from fieldlum.optics.profiles import CameraProfile
    from fieldlum.session.site_toml import site_from_table

    table, kind = read_toml(path), "session"
    if "site" in table:
        kind, _ = "site", site_from_table(table, str(path))
    elif "camera" in table:
        kind, _ = "camera profile", build(CameraProfile, table, str(path))
    elif "entry" in table:
        load = load_ascii_profile if "form" in table else load_register_profile
        kind, _ = "instrument profile", load(str(path))
    elif "setup" not in table:
        found = f"a TOML file with the tables {', '.join(table) or '(none)'}"
        expected = "a site, a camera profile, an instrument profile ([[entry]]) or a session"
        raise InputError(path, found, expected, "name such a file")
    # the kind is first, and a key "kind" in the file does not replace it
    return {"kind": kind, **_flat(table)} | {"kind": kind}


def _flat(table: Facts, prefix: str = "") -> Facts:
    """Return nested tables as one table with names such as scale.k; prefix: of the names."""
    flat: Facts = {}
    for name, value in table.items():
        key = prefix + name
        flat |= _flat(value, f"{key}.") if isinstance(value, dict) else {key: value}
    return flat


def _csv(path: Path) -> Facts:
    """Return columns and number of rows of a csv; lines that begin with # do not count."""
    lines = read_bytes(path).decode(errors="replace").splitlines()
    head, *rows = [line for line in lines if not line.startswith("#")] or [""]
    return {"kind": "table", "rows": len(rows), "columns": head}


def _jpeg(path: Path) -> Facts:
    """Return size and exposure of a JPEG frame."""
    from fieldlum.optics.raw import read_jpeg
    from fieldlum.session import exposure_text

    frame = read_jpeg(path)
    exposure = exposure_text(frame.exposure)
    return {"kind": "JPEG frame", "size": _size(frame.codes), "exposure": exposure}


def _raw(path: Path) -> Facts:
    """Return camera, size, exposure and levels [DN] of a raw frame."""
    from fieldlum.optics.raw import read_mosaic
    from fieldlum.session import exposure_text

    mosaic = read_mosaic(path)
    return {
        "kind": "raw frame",
        "camera": f"{mosaic.make} {mosaic.model}".strip(),
        "size": _size(mosaic.counts),
        "cfa": mosaic.cfa,
        "exposure": exposure_text(mosaic.exposure),
        "black_dn": tuple(mosaic.black_dn),
        "white_dn": mosaic.white_dn,
        "largest_dn": int(mosaic.counts.max()),
    }


def _folder(path: Path) -> Facts:
    """Return facts about the session, the model or the predicted year in a folder.

    Raises InputError for another folder.
    """
    from fieldlum.session.codec import read_object
    from fieldlum.session.files.model_files import ModelConfig

    if (path / "session.toml").is_file():
        return _toml(path / "session.toml")
    if (model := ModelConfig.find(path)) is not None:
        return {"kind": "model", **model.state}
    if (year := path / "predict.json").is_file():
        about = read_object(year, "a predicted year", "run fieldlum predict again")
        return {"kind": "predicted year", **about}
    expected = "a folder with session.toml, config.json or predict.json"
    found, remedy = "no session, model or predicted year", "name such a folder, or a file in it"
    raise InputError(path, found, expected, remedy)
