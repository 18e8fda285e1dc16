"""The Python API: the functions of `import fieldlum`, for scripts and notebooks.

Every function takes paths as text or `Path`, and returns arrays in frozen dataclasses. The command
line and this module call the same stages; `docs/python.md` shows both in use.
"""

from __future__ import annotations

from fieldlum.api.files import (
    load_camera_profile,
    load_site,
    open_session,
    read_panorama,
    read_weather,
    write_panorama,
)
from fieldlum.api.learning import fit, light_at, load_model, load_pairs, predict_year
from fieldlum.api.pictures import evaluate_glare, merge_frames, plan_captures
from fieldlum.errors import FieldlumError
from fieldlum.records import Panorama, SunSource

__all__ = [
    "FieldlumError",
    "Panorama",
    "SunSource",
    "evaluate_glare",
    "fit",
    "light_at",
    "load_camera_profile",
    "load_model",
    "load_pairs",
    "load_site",
    "merge_frames",
    "open_session",
    "plan_captures",
    "predict_year",
    "read_panorama",
    "read_weather",
    "write_panorama",
]
