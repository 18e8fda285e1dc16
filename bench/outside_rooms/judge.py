"""Judge fieldlum on rooms that other programs rendered: a line of JSON and one of text a room.

    python bench/outside_rooms/judge.py FIELDLUM OUT ROOM.toml [ROOM.toml ...] [--days 2|4]
                                        [--captures N]

FIELDLUM is the command, for example .venv/bin/fieldlum. Each room: nine days, tested on hours of
the year, with: no patch (none), no [room] at all (free), the tape-measure room (box), the scene
fitted from it (scene), the renderer's own patches (exact). Besides errors of maps and of DGP, it
counts the hours with the sun's disc in view (shown, missed, phantom) and the wrong glare classes.
--days keeps the middle days of June and December, or those and two of March; --captures keeps N
captures, evenly spaced.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
import tomllib
from pathlib import Path
from typing import Any

from make_case import write_case

Json = dict[str, Any]

KEYS = (
    "log10_mse_weighted",
    "expected_log10_mse",
    "trusted_share",
    "dgp_mae",
    "dgp_mse",
    "dgp_mse_own_disc",
    "patch",
)


def run(command: list[str]) -> tuple[Json | None, str, float]:
    """Return a command's JSON or None, its last line of complaint, and its seconds."""
    start = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True)
    seconds = time.monotonic() - start
    if done.returncode:
        return None, (done.stderr.strip().splitlines() or ["no message"])[-1], seconds
    return json.loads(done.stdout), "", seconds


def figures(answer: Json) -> Json:
    """Return the figures of the transport model; None where this version has none."""
    model = next(m for m in answer["models"] if m["name"].startswith("transport"))
    return {key: model.get(key) for key in KEYS}


def kept(rows: list[str], days: int | None, captures: int | None) -> list[str]:
    """Return some lines of a pairs.csv, whose first column is the time in UTC."""
    if days:
        every = sorted({row[:10] for row in rows})
        month = {m: [day for day in every if day[5:7] == m] for m in ("03", "06", "12")}
        named = [month["06"][1], month["12"][1], *(month["03"][:2] if days == 4 else ())]
        rows = [row for row in rows if row[:10] in named]
    if captures:
        rows = [rows[k * len(rows) // captures] for k in range(captures)]
    return rows


def judge(fieldlum: str, file: Path, case: Path, days: int | None, captures: int | None) -> Json:
    """Return the figures of one room."""
    room = tomllib.loads(file.read_text())
    write_case(room, file.parent / room["npz"], case)
    for table in case.glob("*/9d.csv"):
        head, *rows = table.read_text().splitlines()
        table.write_text("\n".join([head, *kept(rows, days, captures), ""]))
    tape, exact, free, scene = (case / part for part in ("tape", "exact", "free", "scene"))
    site = ["--site", str(tape / "site.toml"), "--out", str(scene), "--json"]
    fit, why, fit_s = run([fieldlum, "scene", "fit", str(tape / "9d.csv"), *site])
    chosen = fit["chosen"] if fit else f"refused: {why}"
    row: Json = {"room": file.stem, "fit_s": round(fit_s), "chosen": chosen}
    for name, folder, model, patches in (
        ("none", tape, "transport:none", "none"),
        ("free", free, "transport:none", "none"),
        ("box", tape, "transport", "none"),
        ("scene", tape, "transport", str(scene) if fit else "none"),
        ("exact", exact, "transport", "none"),
    ):
        command = [fieldlum, "bench", str(folder / "9d.csv"), "--test", str(folder / "test.csv")]
        command += ["--site", str(folder / "site.toml"), "--out", str(case / f"o_{name}")]
        command += ["--scene", patches, "--models", model, "--render", "0", "--json"]
        answer, why, seconds = run(command)
        row[name] = {**figures(answer), "s": round(seconds)} if answer else why
        if answer:
            files = [str(folder / name) for name in ("9d.csv", "test.csv", "site.toml")]
            row[name] |= discs(fieldlum, files, patches, model)
    return row


def discs(fieldlum: str, files: list[str], scene: str, model: str) -> Json:
    """Return counts of discs and wrong classes by `discs.py`, or its complaint.

    files: captures, test hours, site.
    """
    python = str(Path(fieldlum).parent / "python")
    script = str(Path(__file__).parent / "discs.py")
    counts, why, _ = run([python, script, *files, scene, model])
    return counts or {"discs": why}


def line(row: Json) -> str:
    """Return the row as one line to read."""
    parts = []
    for name, value in row.items():
        if not isinstance(value, dict):
            continue
        text = f"{name} {value['log10_mse_weighted']:.2e} (DGP MSE {_short(value['dgp_mse'])}"
        text += f", own disc {_short(value['dgp_mse_own_disc'])}"
        if "disc_shown" in value:
            text += f"; discs {value['disc_shown']} of {value['disc_hours']}"
            text += f", phantom {value['disc_phantom']} of {value['disc_absent']}"
            text += f", wrong class {100 * value['class_wrong_own_disc']:.1f} %"
        parts.append(text + ")")
    return f"# {row['room']}: fit {row['fit_s']} s, {row['chosen'][:60]}; " + ", ".join(parts)


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Judge fieldlum on rooms of other renderers.")
    parser.add_argument("fieldlum")
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--days", type=int, choices=(2, 4))
    parser.add_argument("--captures", type=int)
    wanted = parser.parse_args()
    for file in wanted.rooms:
        case = wanted.out / file.stem
        row = judge(wanted.fieldlum, file, case, wanted.days, wanted.captures)
        print(json.dumps(row), flush=True)
        print(line(row), flush=True)


if __name__ == "__main__":
    main()
