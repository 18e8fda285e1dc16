"""Camera profiles from ordinary captures: response, vignetting, scale, lens and colour.

Every fit tries small models first and takes the smallest whose held-out error is within one
standard error of the best. A line with the choice goes into the profile.
"""

from fieldlum.calibrate.readings_csv import save_calibration
