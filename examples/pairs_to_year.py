# %% [markdown]
# # A pairs.csv to a model to a year
#
# Captured hours with their irradiance become a model of the room, and the model predicts every
# daylight hour of a weather year with glare in four directions. The hours are rendered here by
# fieldlum's simulator, small and coarse; with your own session, replace `session` by its folder.
#
# Run it whole, `python examples/pairs_to_year.py [FOLDER]`, or cell by cell in an editor.

# %%
import sys
import tempfile
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

import fieldlum
from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
site_file = folder / "office.toml"
weather_file = shipped("capture_plans") / "seattle_dni_dhi.csv"

# %% [markdown]
# ## Describe the room
# Only [site] is required; [room] gives the sun patches, and here the simulator its room.

# %%
folder.mkdir(parents=True, exist_ok=True)
site_file.write_text(
    """
[site]
name = "Small office"
latitude_deg = 47.6
longitude_deg = -122.3
timezone = "America/Los_Angeles"

[camera]
heading_deg = 180.0

[room]
kind = "box"
width_m = 4.0
depth_m = 6.0
height_m = 3.0
camera_x_m = 2.0
camera_y_m = 3.0

[[room.window]]
wall = "south"
left_m = 0.5
width_m = 3.0
sill_m = 0.9
height_m = 1.8
transmittance = 0.8
""",
    encoding="utf-8",
)

# %% [markdown]
# ## Plan four days and render them
# `plan_captures` writes a session; the simulator renders the office at its hours and writes
# pairs.csv. A real session gets its pairs.csv from `fieldlum capture`, `merge` and `pair`.

# %%
plan = fieldlum.plan_captures(
    site_file, "4-day", out=folder / "session", year=2027, today=date(2027, 1, 1)
)
session = fieldlum.open_session(folder / "session")
weather = fieldlum.read_weather(weather_file, site_file)
simulate.run(session, weather, height=12, quality="draft", workers=1)
print(f"{len(plan.slots)} hours planned; {len(weather)} hours of weather")

# %% [markdown]
# ## Fit a model
# `transport` learns how the room answers to sky and sun, and how uncertain each pixel is. Without
# `model="transport"`, all models are compared on held-out days and one is chosen.

# %%
data = fieldlum.load_pairs(session)
print(f"maps: {data.luminance_cdm2.shape} cd/m2")
model = fieldlum.fit(data, "transport", patch="none", out=session.models / "transport")
print(f"{model.name}: {model.parameters} parameters")

# %% [markdown]
# ## One moment
# Any sky and sun can be asked for; `trusted` is False where the captures hold nothing alike.

# %%
noon_utc = datetime(2027, 12, 21, 20, 0, tzinfo=UTC)
light = fieldlum.light_at([noon_utc], site_file, dni_wm2=600.0, dhi_wm2=60.0)
prediction = fieldlum.load_model(session.models / "transport").predict(light)
print(
    f"a clear winter noon: mean {prediction.luminance_cdm2[0].mean():.0f} cd/m2, "
    f"trusted: {bool(prediction.trusted[0])}"
)

# %% [markdown]
# ## A year of glare, in 36 days
# To be quick, three days of each month; give `weather_file` itself for the full year. `hours` and
# `views` hold one column each by name; predict.json and hourly.csv are in the folder.

# %%
short_file = folder / "36-days.csv"
lines = weather_file.read_text(encoding="utf-8").splitlines()
chosen = [
    line
    for line in lines
    if line.startswith(("#", "month")) or line.split(",")[1] in ("1", "11", "21")
]
short_file.write_text("\n".join(chosen), encoding="utf-8")
year = fieldlum.predict_year(session.models / "transport", short_file, views=4)
dgp = year.views["dgp"][year.occupied]  # [n occupied, 4]
for j, azimuth_deg in enumerate(year.azimuths_deg):
    above = 100 * np.mean(dgp[:, j] > 0.40)
    print(f"view to {azimuth_deg:5.1f} deg: DGP above 0.40 in {above:.1f} % of occupied hours")
print(f"{len(year)} daylight hours in {year.folder.relative_to(folder)}/hourly.csv")
