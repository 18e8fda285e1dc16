"""Camera profiles from ordinary captures: response, vignetting, scale, lens and colour.

Every fit tries small models first and takes the smallest whose held-out error is within one
standard error of the best; it says so in a line that goes into the profile.
"""

from fieldlum.calibrate.frames import LinearFrame, Patch, linear_frame
from fieldlum.calibrate.keep import keep
from fieldlum.calibrate.order import Candidate, Choice, choose, folds

__all__ = ["Candidate", "Choice", "LinearFrame", "Patch", "choose", "folds", "keep", "linear_frame"]
