"""Run all stages on simulated captures, and compare the results with the truth.

Radiance renders the office of Liu, Colburn and Inanici (2020) at every planned hour. A simulated
camera takes raw brackets of it, and a simulated SPN1 is read; later stages
read the same files as those of real devices. Merged, paired and predicted results are then compared
with the rendered truth.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.records import Progress
from fieldlum.core.scheduler import in_processes
from fieldlum.optics.profiles import shipped
from fieldlum.optics.projection import compass_name
from fieldlum.room.simulate import Troubles
from fieldlum.session import Session, open_session, replacing
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.scores_json import TrainAnswer
from fieldlum.session.files.truth_csv import TruthIrradiance
from fieldlum.session.site_toml import load_site
from fieldlum.sky.sky_view import SkyView
from fieldlum.sky.sky_view.view import NAME as SKY_VIEW
from fieldlum.weather import Weather
from fieldlum.year.predict import Annual

MODEL = "auto"
WEATHER = "seattle_dni_dhi.csv"
YEAR = 2027  # of the simulated captures; chosen


@dataclass(frozen=True, slots=True)
class Preset:
    """Settings of a demo: rows of the maps [px], quality of the truth, minutes of training.

    height: rows of the panoramas, which are twice as wide; quality: of the rendered truth;
    budget_min: of `train`; troubles: a file in capture_plans/, or "" for none.
    """

    height: int
    quality: str
    budget_min: float
    troubles: str = ""


PRESETS = {
    "quick": Preset(115, "quick", 2.0),
    "paper": Preset(230, "paper", 30.0),
    "hard": Preset(58, "draft", 2.0, "troubles/hard.toml"),
}

# Words of the notes of `train` that name a trouble. No note names the other troubles.
NAMED_BY = {
    "clouds": "the skies in the windows differ",
    "north": "north is wrong",
    "clock_drift": "clock of the pictures differs",
    "knock": "camera was turned",
    "lamps": "a lamp was on, but not marked",
    "blind": "a moved blind",
}
TEST_HOURS = 60  # of the year, with which a model of troubled captures is compared; chosen

Show = Callable[[str], Any]
"""Called with a stage's name; returns a context manager that yields a Progress."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the demo.

    report: path of the report page; seconds: duration of each stage by its name [s]; figures: rows
    of the printed table, each with name, value and remark.
    """

    report: Path
    seconds: dict[str, float]
    figures: tuple[tuple[str, str, str], ...]


def prepare(folder: Path) -> Session:
    """Open the session in `folder`; if there is none, plan nine days in the shipped office."""
    from fieldlum import plan

    if (folder / "session.toml").is_file():
        return open_session(folder)
    setup = load_site(shipped("capture_plans") / "seattle-office.toml")
    # The demo's camera is the simulated default: nothing is assumed about a real one.
    setup = replace(setup, camera=replace(setup.camera, assumed=()))
    session, _ = plan.run(setup, plan.Request("9-day", today=date(YEAR, 1, 1)), folder)
    return session


def capture(session: Session, seed: int, progress: Progress) -> None:
    """Capture all due slots with a simulated camera and pyranometer.

    The clock jumps from slot to slot, so that nothing waits. seed: of the simulated noise.
    """
    from fieldlum import capture as stage
    from fieldlum.capture.bracket import FrameChecks
    from fieldlum.capture.live import Live
    from fieldlum.capture.verify import doubts

    def watch(live: Live) -> None:
        progress(live.done, live.planned, live.next_slot)

    clock, options = stage.prepare(session, fast=True)
    place = f"sim:office?seed={seed}"
    stage.run(
        session, place, place, clock=clock, options=options, watch=watch, checks=FrameChecks(doubts)
    )


def merged_against_truth(session: Session) -> tuple[float, float, int]:
    """Compare merged panoramas with their rendered truth, over unflagged pixels.

    Return the median absolute relative error (median of the maps' medians), the mean share of
    pixels within 5 %, both as fractions, and the number of maps. Maps without a truth are skipped,
    and pixels with a truth of 0.
    """
    from fieldlum.optics.images import read_panorama

    medians, within = [], []
    for path in session.panorama_files():
        truth_path = session.truth_panorama(path.stem)
        if not truth_path.is_file():
            continue
        merged, truth = read_panorama(path), read_panorama(truth_path)
        good = (
            np.ones(merged.luminance_cdm2.shape, bool)
            if merged.flags is None
            else merged.flags == 0
        )
        good &= truth.luminance_cdm2 > 0
        error = np.abs(merged.luminance_cdm2[good] / truth.luminance_cdm2[good] - 1.0)
        medians.append(float(np.median(error)))
        within.append(float((error < 0.05).mean()))
    return float(np.median(medians)), float(np.mean(within)), len(medians)


def irradiance_against_truth(session: Session) -> tuple[float, float]:
    """Return the rms errors of DNI and of DHI in pairs.csv against the simulated truth [W/m2].

    Only usable rows with the sun above 10 degrees count.
    """
    truth = TruthIrradiance.read(session.truth_irradiance)
    rows_of_hours = {int(t // 3600): k for k, t in enumerate(truth.t_unix_s)}
    errors = [
        (row.dni_wm2 - truth.dni_wm2[k], row.dhi_wm2 - truth.dhi_wm2[k])
        for row in PairsFile.read(session.pairs).usable
        if row.sun_altitude_deg > 10
        and (k := rows_of_hours.get(int(row.t_utc.timestamp() // 3600))) is not None
    ]
    dni, dhi = np.sqrt(np.mean(np.square(errors), axis=0))
    return float(dni), float(dhi)


def troubles_named(notes: Iterable[str]) -> list[str]:
    """Return the names in `NAMED_BY`, in its order, whose words occur in the notes of `train`.

    These are possible causes, also of troubles that were not simulated.
    """
    texts = list(notes)
    return [name for name, words in NAMED_BY.items() if any(words in text for text in texts)]


def _troubled_figures(
    session: Session, model: Path, troubles: Troubles, how: Preset, year: Weather, notes: list[str]
) -> tuple[tuple[str, str, str], ...]:
    """Return which troubles were named, and the model's error in hours without passing ones.

    The wrong north is in these hours, because it lasts.
    """
    from fieldlum.learn import models
    from fieldlum.learn.models.data import load_pairs
    from fieldlum.learn.models.scores import evaluate, summary, truth
    from fieldlum.room import simulate

    named = [name for name in troubles_named(notes) if name in troubles.names]
    rest = [name for name in troubles.names if name not in named]
    folder = session.truth / "test-hours"
    if (folder / "session.toml").is_file():
        test = open_session(folder)
    else:
        setup = session.site_file()
        captured = [slot.t_utc for slot in session.slots()]
        hours = simulate.sample_slots(setup, year, TEST_HOURS, 1, captured)
        test = simulate.make_session(folder, setup, hours, {"set": "test"})
    lasting = troubles.only("north") if troubles.north is not None else None
    simulate.run(
        test, year, height=how.height, quality=how.quality, troubles=lasting, cache=session.truth
    )
    hours = replace(load_pairs(test), sky_view=SkyView.find(model / SKY_VIEW))
    scores = summary(evaluate(models.load(model), truth(hours)))
    return (
        (
            "its error",
            f"{scores['log10_mse_weighted']:.2e}",
            f"log10 MSE in {TEST_HOURS} hours of the year without passing troubles; the model "
            f"expected {scores['expected_log10_mse']:.2e}",
        ),
        (
            "its DGP",
            f"{math.sqrt(scores['dgp_mse_own_disc'] or math.nan):.3f}",
            f"rms error in these hours; {scores['trusted_share']:.0%} of them are trusted",
        ),
        ("troubles named", f"{len(named)} of {len(troubles.names)}", ", ".join(named) or "none"),
        ("not named", f"{len(rest)}", ", ".join(rest) or "none"),
    )


def _figures(
    session: Session, scores: TrainAnswer, annual: Annual, *, troubled: bool
) -> tuple[tuple[str, str, str], ...]:
    median, within, maps = merged_against_truth(session)
    dni, dhi = irradiance_against_truth(session)
    from fieldlum.learn import models
    from fieldlum.year import predict

    captures = len(models.read_config(session.models / MODEL).training.slots)
    chosen = next(row for row in scores["models"] if row["name"] == scores["chosen"])
    ends = predict.best_and_worst(annual.summary.protection)
    assert ends is not None  # the demo's lenses see every direction
    best = ends[0]
    return (
        (
            "merged luminance",
            f"{100 * median:.2f} %",
            f"median error against the truth, {maps} brackets",
        ),
        ("", f"{100 * within:.1f} %", "of the unflagged pixels within 5 % of the truth"),
        (
            "paired DNI, DHI",
            f"{dni:.1f}, {dhi:.1f} W/m²",
            "rms difference from the simulated, troubled instrument, sun above 10°"
            if troubled
            else "rms error against the truth, sun above 10°",
        ),
        (
            "model chosen",
            scores["chosen"],
            f"fitted in {scores['final_fit_s']:.1f} s to all {captures} captures",
        ),
        (
            "its error",
            f"{chosen['log10_mse_weighted']:.2e}",
            "log10 MSE on held-out days"
            + (", whose pictures have the troubles" if troubled else ", solid-angle weighted"),
        ),
        (
            "a year",
            f"{len(annual)} hours",
            f"predicted at {annual.summary.width} x {annual.summary.height}",
        ),
        (
            "best view",
            f"{compass_name(best.azimuth_deg)}, {best.azimuth_deg:.0f}°",
            best.sentence,
        ),
    )


def run(
    folder: Path,
    *,
    preset: str = "quick",
    seed: int = 1,
    show: Show,
    workers: int = 2,
    weather: Path | None = None,
) -> Outcome:
    """Run all stages in `folder`, write demo.json, and return the outcome.

    preset: a name in `PRESETS`. weather: a weather file; None: the shipped Seattle year. show:
    called with the name of each stage, returns a context manager that yields a progress function.
    workers: number of processes. Results that are already in `folder` are used again.
    """
    from fieldlum import merge, pair, report
    from fieldlum.learn import train
    from fieldlum.learn.models.data import load_pairs
    from fieldlum.pair import irradiance
    from fieldlum.room import simulate
    from fieldlum.year import predict

    how, weather = PRESETS[preset], weather or shipped("capture_plans") / WEATHER
    seconds: dict[str, float] = {}

    def stage(name: str, work: Callable[[Progress], Any]) -> Any:
        started = time.monotonic()
        with show(name) as progress:
            answer = work(progress)
        seconds[name] = round(time.monotonic() - started, 1)
        return answer

    session = stage("plan", lambda _: prepare(folder))
    year = simulate.weather_for(session.site_file(), weather)
    troubles = (
        simulate.load_troubles(shipped("capture_plans") / how.troubles) if how.troubles else None
    )
    render = {
        "height": how.height,
        "quality": how.quality,
        "workers": workers,
        "troubles": None if troubles is None else troubles.seeded(seed - 1),
    }
    stage("render the room", lambda p: simulate.run(session, year, progress=p, **render))
    stage("capture", lambda p: capture(session, seed, p))
    options = merge.MergeOptions(height=how.height)
    stage(
        "merge",
        lambda p: merge.run(session, options, scheduler=in_processes(workers), progress=p),
    )
    stage("pair", lambda p: (irradiance.run(session, progress=p), pair.run(session, progress=p)))
    model = session.models / MODEL
    learning = {"budget_min": how.budget_min, "seed": seed, "out": model}
    scores = stage("train", lambda p: train.run(load_pairs(session), MODEL, progress=p, **learning))
    annual, _ = stage(
        "predict a year",
        lambda p: predict.run(
            model, weather, seed=seed, scheduler=in_processes(workers), progress=p
        ),
    )
    page = stage("report", lambda p: report.run(session, progress=p))
    figures = _figures(session, scores, annual, troubled=troubles is not None)
    if troubles is not None:
        seeded = troubles.seeded(seed - 1)
        figures += _troubled_figures(session, model, seeded, how, year, scores["notes"])
    outcome = Outcome(page, seconds, figures)
    with replacing(folder / "demo.json", "w", encoding="utf-8") as file:
        json.dump(
            {"preset": preset, "seconds": seconds, "figures": outcome.figures, "scores": scores},
            file,
            indent=1,
        )
    return outcome
