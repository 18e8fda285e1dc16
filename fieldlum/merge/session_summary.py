"""What many brackets say together: quality.csv, the shutter's true times, the drift of the light, a
contact sheet.

Each bracket's exposure ratios hold two things: how long the shutter really opened, the same in
every bracket, and how the light changed while the bracket was taken, different in each. The median
over brackets is the shutter; what is left in one bracket, fitted over its seconds, is the drift.
The pyranometer saw the same seconds.
"""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.images import read_panorama
from fieldlum.records import parse_utc
from fieldlum.session import Session, parse_exposure, read_day, replacing
from fieldlum.statistics import median_standard_error, robust_sigma

COLUMNS = (
    "slot",
    "t_utc",
    "verdict",
    "frames",
    "residual_percent",
    "exposure_span_percent",
    "drift_percent",
    "ghi_change_percent",
    "shift_px",
    "shift_u_px",
    "motion_percent",
    "clipped_percent",
    "bloom_percent",
    "below_noise_percent",
    "outside_percent",
    "u_ratio_percent",
    "sun_lx",
    "sun_origin",
    "vertical_illuminance_lx",
)
MIN_BRACKETS = 5  # before a shutter table is believed
_THUMB = (184, 92)
_PER_ROW, _PER_PAGE = 8, 96


@dataclass(frozen=True, slots=True)
class ShutterEntry:
    """One setting of the dial over all brackets: median correction, its standard error, how many
    brackets.
    """

    exposure: str
    nominal_s: float
    correction: float
    u_rel: float
    brackets: int


def shutter_table(qualities: Sequence[dict[str, Any]]) -> list[ShutterEntry]:
    """True over assumed exposure of each setting, from brackets whose neighbours agree; longest
    first.
    """
    found: dict[str, list[float]] = defaultdict(list)
    for quality in qualities:
        if quality.get("residual_percent") is None or abs(quality["residual_percent"]) > 3.0:
            continue
        for frame in quality["frames"]:
            found[frame["exposure"]].append(float(frame["correction"]))
    table = []
    for text, values in found.items():
        logs = np.log(values)
        spread = robust_sigma(logs)
        u = max(median_standard_error(spread, len(logs)), 2e-4)
        table.append(
            ShutterEntry(
                text, parse_exposure(text).shutter_s, float(np.exp(np.median(logs))), u, len(logs)
            )
        )
    return sorted(table, key=lambda e: -e.nominal_s)


def drift_percent(quality: dict[str, Any], table: Sequence[ShutterEntry]) -> float | None:
    """Change of the light from the first frame to the last, by what the shutter table leaves.
    None: cannot tell. [%]
    """
    known = {e.exposure: e.correction for e in table if e.brackets >= MIN_BRACKETS}
    rows = [
        (
            parse_utc(f["t_utc"]).timestamp(),
            float(np.log(f["correction"] / known[f["exposure"]])),
            f["u_percent"],
        )
        for f in quality["frames"]
        if f.get("t_utc") and f["exposure"] in known and f["u_percent"] < 1.0
    ]
    if len(rows) < 3 or max(r[0] for r in rows) - min(r[0] for r in rows) <= 0:
        return None
    seconds, left, u = (np.array(column) for column in zip(*rows, strict=True))
    slope = np.polyfit(seconds - seconds.mean(), left, 1, w=1 / np.maximum(u, 0.02))[0]
    return float(100 * slope * np.ptp(seconds))


def ghi_change_percent(session: Session, opened: datetime, closed: datetime) -> float | None:
    """Change of global irradiance over the same seconds, by a line through the samples. None: no
    samples. [%]
    """
    days = {t.strftime("%Y-%m-%d") for t in (opened, closed)}
    rows = [
        (s.t_utc.timestamp(), s.ghi_wm2)
        for day in sorted(days)
        if (path := session.irradiance / f"{day}.csv").is_file()
        for s in read_day(path)[0]
        if opened <= s.t_utc <= closed and s.ghi_wm2 is not None
    ]
    if len(rows) < 3:
        return None
    seconds, ghi = (np.array(column, float) for column in zip(*rows, strict=True))
    if ghi.mean() < 5.0 or np.ptp(seconds) <= 0:
        return None
    slope = np.polyfit(seconds - seconds.mean(), ghi, 1)[0]
    return float(100 * slope * (closed - opened).total_seconds() / ghi.mean())


def read_notes(session: Session) -> list[dict[str, Any]]:
    """Sidecars of all panoramas, in order of time; what is no sidecar of ours is passed over."""
    notes = []
    for path in sorted(session.panoramas.glob("[0-9]*Z.json")):
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(table.get("quality"), dict) and "frames" in table["quality"]:
                notes.append(table)
        except (OSError, ValueError, AttributeError):
            continue
    return notes


def write_survey(session: Session) -> None:
    """panoramas/quality.csv, panoramas/shutter.csv and contact sheets, of everything merged so
    far.
    """
    notes = read_notes(session)
    table = shutter_table([n["quality"] for n in notes])
    with replacing(session.panoramas / "shutter.csv", "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("exposure", "nominal_s", "true_over_assumed", "u_rel", "brackets"))
        rows.writerows(
            (e.exposure, f"{e.nominal_s:.7g}", f"{e.correction:.6f}", f"{e.u_rel:.2g}", e.brackets)
            for e in table
        )
    _contact_sheets(session, notes)
    with replacing(session.panoramas / "quality.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for note in notes:
            row = _row(session, note, table)
            writer.writerow([row[name] for name in COLUMNS])


def survey_owed(session: Session) -> bool:
    """Whether a sidecar is newer than quality.csv, which is written last: also after a kill in
    the middle.
    """
    known = session.panoramas / "quality.csv"
    written = known.stat().st_mtime_ns if known.is_file() else -1
    return any(path.stat().st_mtime_ns > written for path in session.panoramas.glob("[0-9]*Z.json"))


def _row(session: Session, note: dict[str, Any], table: Sequence[ShutterEntry]) -> dict[str, str]:
    quality, sun = note["quality"], note.get("sun") or {}
    times = [parse_utc(f["t_utc"]) for f in quality["frames"] if f.get("t_utc")]
    ghi = ghi_change_percent(session, min(times), max(times)) if times else None
    shown = {
        **{name: quality.get(name) for name in COLUMNS if name.endswith(("percent", "lx", "px"))},
        "drift_percent": drift_percent(quality, table),
        "ghi_change_percent": ghi,
        "sun_lx": sun.get("normal_illuminance_lx"),
        "frames": len(quality["frames"]),
    }
    text = {k: "" if v is None else f"{v:.4g}" for k, v in shown.items()}
    words = {k: str(note.get(k, "")) for k in ("slot", "t_utc", "verdict")}
    return {**text, **words, "sun_origin": str(sun.get("origin", ""))}


def _contact_sheets(session: Session, notes: Sequence[dict[str, Any]]) -> None:
    """contact-1.png ...: every panorama in false colour, log 1 to 10 000 cd/m2, flagged pixels
    in grey.
    """
    import cv2

    width, height = _THUMB
    for page in range(0, len(notes), _PER_PAGE):
        part = notes[page : page + _PER_PAGE]
        rows = -(-len(part) // _PER_ROW)
        sheet = np.full((rows * (height + 20), _PER_ROW * (width + 6), 3), 255, np.uint8)
        for number, note in enumerate(part):
            x, y = (number % _PER_ROW) * (width + 6), number // _PER_ROW * (height + 20)
            label, black = f"{note['slot']} {note['verdict'].partition(':')[0]}", (0, 0, 0)
            cv2.putText(
                sheet,
                label,
                (x + 2, y + height + 13),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.36,
                black,
                1,
                cv2.LINE_AA,
            )
            path = session.panoramas / f"{note['slot']}.exr"
            if path.is_file():
                sheet[y : y + height, x : x + width] = _thumbnail(path)
        with replacing(session.panoramas / f"contact-{page // _PER_PAGE + 1}.png") as file:
            file.write(cv2.imencode(".png", sheet)[1].tobytes())


def _thumbnail(path: Path) -> NDArray[np.uint8]:
    """[height, width, 3], blue first."""
    import cv2

    panorama = read_panorama(path)
    height, width = panorama.luminance_cdm2.shape
    pick = np.ix_(
        *(
            np.linspace(0, n - 1, m).astype(int)
            for n, m in ((height, _THUMB[1]), (width, _THUMB[0]))
        )
    )
    level = np.log10(np.clip(panorama.luminance_cdm2[pick], 1.0, 1e4)) / 4.0
    picture = np.asarray(
        cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO), np.uint8
    )
    if panorama.flags is not None:
        picture[panorama.flags[pick] > 0] = 150
    return picture
