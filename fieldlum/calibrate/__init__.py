"""Camera profiles from ordinary captures: response, vignetting, scale, lens and colour.

Fits with several models try small ones first and take the smallest whose held-out error is within
one standard error of the best; a line with the choice goes into the profile. Scale, image circle
and bad pixels have one model.
"""

from fieldlum.calibrate.readings_csv import save_calibration
