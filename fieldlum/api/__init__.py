"""The Python API: the functions of `import fieldlum`, for scripts and notebooks.

Functions take paths as text or `Path`. The command line and this module call the same stages;
`docs/python.md` shows both in use.
"""

from fieldlum.api.learning import fit, light_at, load_model, load_pairs, predict_year
from fieldlum.api.measurement import (
    evaluate_glare,
    load_camera_profile,
    load_site,
    merge_frames,
    open_session,
    plan_captures,
    read_panorama,
    read_weather,
    write_panorama,
)
from fieldlum.core.errors import FieldlumError
from fieldlum.core.records import Panorama, SunSource
