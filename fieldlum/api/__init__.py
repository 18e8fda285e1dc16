"""The Python API: the functions of `import fieldlum`, for scripts and notebooks.

Functions take paths as text or `Path`. The command line and this module call the same stages;
`docs/python.md` shows both in use.
"""

from fieldlum.api.learning import fit as fit
from fieldlum.api.learning import light_at as light_at
from fieldlum.api.learning import load_model as load_model
from fieldlum.api.learning import load_pairs as load_pairs
from fieldlum.api.learning import predict_year as predict_year
from fieldlum.api.measurement import evaluate_glare as evaluate_glare
from fieldlum.api.measurement import load_camera_profile as load_camera_profile
from fieldlum.api.measurement import load_site as load_site
from fieldlum.api.measurement import merge_frames as merge_frames
from fieldlum.api.measurement import open_session as open_session
from fieldlum.api.measurement import plan_captures as plan_captures
from fieldlum.api.measurement import read_panorama as read_panorama
from fieldlum.api.measurement import read_weather as read_weather
from fieldlum.api.measurement import write_panorama as write_panorama
from fieldlum.core.errors import FieldlumError as FieldlumError
from fieldlum.core.records import Panorama as Panorama
from fieldlum.core.records import SunSource as SunSource
