# %% [markdown]
# # One bracket to cd/m2 and DGP
#
# Ten raw frames of one hour become a luminance panorama with its uncertainty, and the panorama
# becomes daylight glare probability in four directions. A simulated camera takes the frames here;
# with your own camera, replace the list of files and the name of the profile.
#
# Run it whole, `python examples/bracket_to_dgp.py [FOLDER]`, or cell by cell in an editor.

# %%
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import fieldlum
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.office import Office
from fieldlum.optics.profiles import bracket_exposures

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
folder.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## Take a bracket
# `SimulatedCamera` writes the same DNG files as a raw camera would. The profile states the
# exposures of the bracket.

# %%
profile = fieldlum.load_camera_profile("sim-dual-fisheye")
start_utc = datetime(2027, 3, 20, 20, 30, tzinfo=UTC)
camera = SimulatedCamera(Office(seed=3), profile, FastClock(start_utc), heading_deg=180.0)
frames = [
    camera.expose(exposure, folder / f"frame-{i}")
    for i, exposure in enumerate(bracket_exposures(profile.bracket))
]
print(f"{len(frames)} frames, {frames[0].name} to {frames[-1].name}")

# %% [markdown]
# ## Merge it to luminance
# Every pixel gets a luminance and a standard uncertainty; flags name what to read with care.

# %%
result = fieldlum.merge_frames(frames, profile, height=115, heading_deg=180.0)
panorama = result.panorama
assert panorama.u_cdm2 is not None
luminance_cdm2 = panorama.luminance_cdm2  # [115, 230]
print(f"verdict: {result.verdict}")
print(f"luminance: {luminance_cdm2.min():.1f} to {luminance_cdm2.max():.0f} cd/m2")
print(f"mean relative uncertainty: {100 * (panorama.u_cdm2 / luminance_cdm2).mean():.1f} %")
fieldlum.write_panorama(folder / "office.exr", panorama)  # all channels
fieldlum.write_panorama(folder / "office.hdr", panorama)  # for Radiance and HDR viewers

# %% [markdown]
# ## Evaluate glare
# A panorama can be looked at in any direction: south is the window here.

# %%
glare = fieldlum.evaluate_glare(panorama, [0.0, 90.0, 180.0, 270.0])
for view in glare["views"]:
    print(
        f"view to {view['azimuth_deg']:5.1f} deg: DGP {view['dgp']:.3f} ({view['verdict']}), "
        f"Ev {view['ev_lx']:.0f} lx"
    )
for warning in glare["warnings"]:
    print(f"note: {warning}")
