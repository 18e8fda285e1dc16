"""Fit the parts of a camera profile to ordinary captures.

A fit with several models takes the smallest whose held-out error is within one standard error of
the best. The profile stores a line about each fit.
"""

from fieldlum.calibrate.fit_steps import save_calibration
