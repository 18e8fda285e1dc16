"""Run all stages on simulated captures, and compare the results with the truth.

The simulator renders the office of Liu, Colburn and Inanici (2020) at every planned hour. Its
camera takes raw brackets, and its SPN1 is read; later stages
read the same files as those of real devices. Merged, paired and predicted results are then compared
with the rendered truth.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.progress import progress
from fieldlum.core.scheduler import Scheduler
from fieldlum.optics import profiles, projection
from fieldlum.session import Session, open_session, site_toml
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.model_files import TrainAnswer
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.journal import EventFields
from fieldlum.year import predict

MODEL = "auto"
CAMERA = "sim-dual-fisheye-colour"
WEATHER = "seattle_dni_dhi.csv"
YEAR = 2027  # of the simulated captures; chosen


# Height of the panoramas [px] (they are twice as wide), quality of the rendering, and minutes of
# training for the dense network. In two minutes it would not see each pixel once: quick skips it.
PRESETS = {"quick": (115, "quick", 0.0), "paper": (230, "paper", 30.0)}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of the demo.

    report: path of the report page; seconds: duration of each stage by its name [s]; figures: rows
    of the printed table, each with name ("" for a second value of the row before), value with unit,
    and remark.
    """

    report: Path
    seconds: dict[str, float]
    figures: tuple[tuple[str, str, str], ...]


def prepare(folder: Path) -> Session:
    """Return the session in `folder`; if there is none, plan nine days in the shipped office.

    The plan is written to `folder`. Raises InputError for a session of another site, to which
    simulated frames would be added.
    """
    from fieldlum import plan

    setup = site_toml.load_site(profiles.shipped("capture_plans") / "seattle-office.toml")
    if (folder / "session.toml").is_file():
        if open_session(folder).site_file().site != setup.site:
            raise InputError(folder, "a session of another site", "a new folder", "name one")
        return open_session(folder)
    # The simulated camera is calibrated, for colour too, so that no setting is only assumed.
    setup = replace(setup, camera=replace(setup.camera, profile=CAMERA, assumed=()))
    session, _ = plan.run(setup, plan.Request("9-day", today=date(YEAR, 1, 1)), folder)
    return session


def capture(session: Session, completed: Callable[[str], object] = lambda slot: None) -> None:
    """Capture all due slots with a simulated camera and pyranometer.

    The clock jumps from slot to slot, so that nothing waits. completed: called with the id of each
    slot (`Slot.id`) as soon as its bracket is complete.
    """
    from fieldlum import capture as stage
    from fieldlum.capture.bracket import FrameChecks
    from fieldlum.capture.frame_checks import compare_exif
    from fieldlum.capture.runner import Live

    def watch(live: Live) -> None:
        """Show the progress of the capture."""
        progress(live.done, live.planned, live.next_slot)

    def listen(event: str, t_utc: datetime, fields: EventFields) -> None:
        """Report a complete bracket to `completed`."""
        if event == "done":
            completed(fields["slot"])

    clock, options = stage.prepare(session, fast=True)
    device_uri = "sim:office?seed=1"  # both the camera and the pyranometer; seed of their noise
    settings = {"clock": clock, "options": options, "watch": watch, "listen": listen}
    stage.run(session, device_uri, device_uri, **settings, checks=FrameChecks(compare_exif))


def merged_against_truth(session: Session) -> tuple[float, float, int]:
    """Return the error of merged panoramas against their rendered truth, over unflagged pixels.

    The three values are the median absolute relative error (median of the maps' medians), the mean
    share of pixels within 5 %, both as fractions, and the number of maps. Maps without a truth are
    skipped, and pixels with a truth of 0. Without any map the fractions are NaN.
    """
    from fieldlum.optics.images import read_panorama

    medians, within = [], []
    for path in session.panorama_files():
        truth_path = session.truth_panorama(path.stem)
        if not truth_path.is_file():
            continue
        merged, truth = read_panorama(path), read_panorama(truth_path)
        flags = 0 if merged.flags is None else merged.flags
        used = (flags == 0) & (truth.luminance_cdm2 > 0)
        error = np.abs(merged.luminance_cdm2[used] / truth.luminance_cdm2[used] - 1.0)
        medians.append(float(np.median(error)))
        within.append(float((error < 0.05).mean()))
    return float(np.median(medians)), float(np.mean(within)), len(medians)


def irradiance_against_truth(session: Session) -> tuple[float, float]:
    """Return the rms errors of DNI and of DHI in pairs.csv against the simulated truth [W/m2].

    Only usable rows with the sun above 10 degrees count, whose hour is in the truth.
    """
    truth = CleanIrradiance.read_truth(session.truth_irradiance)
    index_of_hour = {int(t // 3600): k for k, t in enumerate(truth.t_unix_s)}  # hours since 1970
    errors = [
        (row.dni_wm2 - truth.dni_wm2[k], row.dhi_wm2 - truth.dhi_wm2[k])
        for row in PairsFile.read(session.pairs).usable
        if row.sun_altitude_deg > 10
        and (k := index_of_hour.get(int(row.t_utc.timestamp() // 3600))) is not None
    ]
    dni, dhi = np.sqrt(np.mean(np.square(errors), axis=0))
    return float(dni), float(dhi)


def _figures(
    session: Session, scores: TrainAnswer, annual: predict.Annual
) -> tuple[tuple[str, str, str], ...]:
    """Return the rows that the demo prints: name of a figure, its value with unit, and a remark.

    scores: of training; annual: the predicted year.
    """
    from fieldlum.learn import models

    median, within, maps = merged_against_truth(session)
    dni, dhi = irradiance_against_truth(session)
    captures = len(models.read_config(session.models / MODEL).training.slots)
    chosen = next(row for row in scores["models"] if row["name"] == scores["chosen"])
    directions = predict.best_and_worst(annual.summary.protection)
    assert directions is not None  # the demo's lenses see every direction
    best, size = directions[0], f"{annual.summary.width} x {annual.summary.height}"
    fitted = f"fitted in {scores['final_fit_s']:.1f} s to all {captures} captures"
    of_truth = f"median error against the truth, {maps} brackets"
    irradiance = f"{dni:.1f}, {dhi:.1f} W/m²"
    error = f"{chosen['log10_mse_weighted']:.2e}"
    view = f"{projection.compass_name(best.azimuth_deg)}, {best.azimuth_deg:.0f}°"
    return (
        ("merged luminance", f"{100 * median:.2f} %", of_truth),
        ("", f"{100 * within:.1f} %", "of the unflagged pixels within 5 % of the truth"),
        ("paired DNI, DHI", irradiance, "rms error against the truth, sun above 10°"),
        ("model chosen", scores["chosen"], fitted),
        ("its error", error, "log10 MSE on held-out days, solid-angle weighted"),
        ("a year", f"{len(annual)} hours", f"predicted at {size}"),
        ("best view", view, best.sentence),
    )


def run(
    folder: Path,
    *,
    preset: str = "quick",
    show: Callable[[str], AbstractContextManager[None]],
    weather: Path | None = None,
) -> Outcome:
    """Run all stages in `folder`, and return the outcome.

    folder: of the session, created if needed. preset: a name in `PRESETS`. weather: a weather file;
    None: the shipped Seattle year. show: called with the name of each stage, returns a context
    manager that shows its progress. Brackets are merged in another process while later ones are
    captured. Results that are already in `folder` are used again. Raises InputError as `prepare`,
    and for a weather file that cannot be used.
    """
    from fieldlum import merge, pair, report
    from fieldlum.learn import train
    from fieldlum.learn.models.training_data import load_pairs
    from fieldlum.pair import irradiance
    from fieldlum.room import simulate

    height, quality, budget_min = PRESETS[preset]
    weather, pool = weather or profiles.shipped("capture_plans") / WEATHER, Scheduler(2)
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        """Show the progress of a stage in a `with` block, and store its duration at the end [s]."""
        started_s = time.monotonic()
        with show(name):
            yield
        seconds[name] = round(time.monotonic() - started_s, 1)

    with stage("plan"):
        session = prepare(folder)
    year, model = simulate.weather_for(session.site_file(), weather), session.models / MODEL
    with stage("render the room"):
        simulate.run(session, year, height=height, quality=quality, coloured=True)
    size = merge.MergeOptions(height=height)
    with stage("capture"), merge.merging(session, size) as merge_slot:
        capture(session, merge_slot)
    with stage("merge"):
        merge.run(session, size, scheduler=pool)
    with stage("pair"):
        irradiance.run(session)
        pair.run(session)
    with stage("train"):
        scores = train.run(load_pairs(session), MODEL, budget_min=budget_min, seed=1, out=model)
    with stage("predict a year"):
        annual, _ = predict.run(model, weather, scheduler=pool)
    with stage("report"):
        page = report.run(session)
    return Outcome(page, seconds, _figures(session, scores, annual))
