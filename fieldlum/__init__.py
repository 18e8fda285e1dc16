"""A camera, a pyranometer and a laptop on site: a year of luminance maps of a room.

The names of the Python API are loaded from `fieldlum.api` when they are first used, so that
`import fieldlum` and the command line's --help stay fast. docs/python.md lists them.
"""

# ruff: noqa: F403, F405
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fieldlum.api import *
    from fieldlum.version import __version__

# The list of the API. `fieldlum.api` imports each name; a test compares them.
__all__ = [
    "FieldlumError",
    "Panorama",
    "SunSource",
    "__version__",
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


def __getattr__(name: str) -> Any:
    """Return a name of the API, loaded at its first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module 'fieldlum' has no attribute '{name}'")
    from fieldlum import api, version

    return getattr(version if name == "__version__" else api, name)


def __dir__() -> list[str]:
    """Return the names of the API, for completion."""
    return sorted(__all__)
