"""`fieldlum predict`: run a weather year through a trained model."""

from pathlib import Path
from typing import Annotated, Any

import click

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import print_answer, progress, say


@command_of("predict")
def command(
    model_folder: Annotated[Path, "MODELDIR"],
    weather_path: Path,
    label_shift_min: float = 0.0,
    out: Path | None = None,
    maps: bool = False,
    views: Annotated[int, click.IntRange(1, 360)] = 10,
    occupancy_path: Path | None = None,
    lamps: str = "",
    sky_view: Path | None = None,
    scheduler: Any = "local",
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Predict a year of maps and glare from a weather file.

    Writes hourly.csv (vertical illuminance, DGP, UGR and more for every daylight hour and
    direction), predict.json (classes by EN 17037, with their confidence) and the maps of some
    typical hours.

    \b
    Example:
      fieldlum predict office-2027/models/auto --weather seattle.epw --views 10

    Options:
      --weather: EPW, TMY3, TMY2, PVGIS, NSRDB, SAM, SolarAnywhere or CSV; or the word
          synthetic, for an invented year that must not be used to judge a place.
      --out: Folder of the year to write. [default: SESSION/annual/NAME]
      --maps: Also write every map, as Zarr (about 0.7 GB for a year at 460 x 230).
      --views: Number of view directions, evenly spread around.
      --occupancy: When the room is used: csv days,start,end, or 8760 rows of occupied.
          [default: 08:00 to 18:00]
      --lamps FILE|off: When lamps that are marked in the captures are on: a csv as for
          --occupancy, or off. [default: as in captures without a mark]
    """
    from fieldlum.optics.projection import compass_name
    from fieldlum.session.files.pairs_csv import PairsFile
    from fieldlum.year.predict import run

    with progress("predict"):
        annual, new = run(
            model_folder,
            weather_path,
            out=out,
            maps=maps,
            views=views,
            occupancy_path=occupancy_path,
            lamps=lamps,
            sky_view=sky_view,
            force=force,
            label_shift_min=label_shift_min,
            scheduler=scheduler,
        )
    summary = annual.summary
    notes = [f"note: {text}" for text in (*summary.weather.repairs, *summary.notes)]
    if not new:
        same = "this year was predicted from the same model, weather and settings"
        notes.insert(0, f"nothing to do: {same} (--force predicts it again)")
    # of the model's session; a model elsewhere has no such file
    notes += PairsFile.find(model_folder.resolve().parent.parent / "pairs.csv").pair_again
    for text in () if as_json else dict.fromkeys((*summary.model_warnings, *notes)):
        say(text)
    lines = [f"{summary.hours} daylight hours in {annual.folder / 'hourly.csv'}"]
    for row in summary.protection:
        direction = f"{compass_name(row.azimuth_deg):3} {row.azimuth_deg:5.1f}°"
        lines.append(f"  {direction}  {row.sentence}")
    print_answer(as_json, {"folder": str(annual.folder), "new": new, **annual.about}, lines)
