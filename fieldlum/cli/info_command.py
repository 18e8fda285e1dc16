"""`fieldlum info`: describe any file of fieldlum."""

from pathlib import Path
from typing import Any

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import emit_json, say, tell
from fieldlum.core.errors import InputError, did_you_mean
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
    bad = 0
    for path in files:
        try:
            facts = {"file": str(path), **describe(path, part)}
        except InputError as error:
            say(f"fieldlum info: {error}")
            bad += 1
            continue
        if json_lines:
            emit_json(facts)
        else:
            tell(facts.pop("file"))
            for name, value in facts.items():
                is_table = isinstance(value, list) and value and isinstance(value[0], dict)
                for row in value if is_table else [value]:
                    tell(f"  {name:24} {_short(row)}".replace("\n", " "))
    if bad:
        raise SystemExit(InputError.exit_code)


def _short(value: Any) -> str:
    """Return a value as text, which may be shortened; `--json` has all of it."""
    pairs = value.items() if isinstance(value, dict) else ()
    text = ", ".join(f"{name} {shown}" for name, shown in pairs) or str(value)
    return text if len(text) <= 200 else f"{text[:200]} ..."


def describe(path: Path, part: str = "") -> Facts:
    """Return what `fieldlum info` prints about a file or folder, by name, without its path.

    Which names there are depends on the kind of file (docs/cli.md).
    part: name of the part, layer or stereo view of an .exr; "" for the only one. Raises InputError
    if the file is missing, invalid or of an unknown kind.
    """
    from fieldlum.optics.profiles import camera_names, find_camera_profile
    from fieldlum.session.codec import change_of

    if not path.exists() and str(path) in camera_names():
        path = find_camera_profile(str(path))
    if path.is_dir():
        return _folder(path)
    if not path.exists():
        near = did_you_mean(str(path), camera_names())
        raise InputError(path, "no such file or folder", remedy=f"check the path{near}")
    suffix = path.suffix.lower()
    change_of(path)
    if suffix == ".exr":
        return _exr(path, part)
    readers = {".hdr": _radiance, ".toml": _toml, ".csv": _csv, ".jpg": _jpeg, ".jpeg": _jpeg}
    return readers.get(suffix, _raw)(path)


def _size(picture: Any) -> str:
    """Return width x height of an array [h, w, ...]."""
    return f"{picture.shape[1]} x {picture.shape[0]}"


def _light(luminance_cdm2: Any) -> Facts:
    """Return size, median and largest finite luminance."""
    import numpy as np

    values = luminance_cdm2[np.isfinite(luminance_cdm2)]
    median, largest = round(float(np.median(values)), 3), round(float(values.max()), 1)
    return {"size": _size(luminance_cdm2), "median_cdm2": median, "largest_cdm2": largest}


def _exr(path: Path, part: str) -> Facts:
    """Return facts about a panorama, or about a picture with the view that `glare` uses."""
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
    from fieldlum.optics.images import read_radiance_hdr

    image, header = read_radiance_hdr(path)
    view = header.view or ("missing" if header.heading_deg is None else "equirect")
    return {"kind": "Radiance picture", "view": view, **_light(image.luminance_cdm2)}


def _toml(path: Path) -> Facts:
    """Return the keys of a TOML file of fieldlum, which must be valid, and its kind."""
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
    return {"kind": kind, **_flat(table)} | {"kind": kind}


def _flat(table: Facts, prefix: str = "") -> Facts:
    """Return nested tables as one, with names such as scale.k."""
    flat: Facts = {}
    for name, value in table.items():
        key = prefix + name
        flat |= _flat(value, f"{key}.") if isinstance(value, dict) else {key: value}
    return flat


def _csv(path: Path) -> Facts:
    lines = read_bytes(path).decode(errors="replace").splitlines()
    head, *rows = [line for line in lines if not line.startswith("#")] or [""]
    return {"kind": "table", "rows": len(rows), "columns": head}


def _jpeg(path: Path) -> Facts:
    from fieldlum.optics.raw import read_jpeg
    from fieldlum.session import exposure_text

    frame = read_jpeg(path)
    exposure = exposure_text(frame.exposure)
    return {"kind": "JPEG frame", "size": _size(frame.codes), "exposure": exposure}


def _raw(path: Path) -> Facts:
    """Return the facts of a raw frame."""
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
    """Return the facts of a session, a model or a predicted year by its folder."""
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
