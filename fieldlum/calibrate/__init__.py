"""Camera profiles from ordinary captures: response, vignetting, scale, lens and colour.

Every fit tries small models first and takes the smallest whose held-out error is within one
standard error of the best. A line with the choice goes into the profile.
"""

from fieldlum.calibrate.frames import LinearFrame, Patch, linear_frame
from fieldlum.calibrate.model_selection import Candidate, OrderSelection, choose, folds
from fieldlum.calibrate.readings_csv import save_calibration

__all__ = [
    "Candidate",
    "LinearFrame",
    "OrderSelection",
    "Patch",
    "choose",
    "folds",
    "linear_frame",
    "save_calibration",
]
