"""Compute with exposures and luminances: shutter times, responses, exposure ratios, vignetting."""

from fieldlum.optics.photometry.curves import (
    check_vignetting,
    dark_floor,
    fit_response,
    linearity_factor,
    monotone,
    polynomial_table,
    response_table,
    rises,
    srgb_table,
    vignetting_at,
)
from fieldlum.optics.photometry.exposure import (
    SAME_SETTING_EV,
    prior_u_log,
    same_exposure,
    saturation_plateau,
    snap_shutter_s,
    z_per_cdm2,
)
from fieldlum.optics.photometry.illuminance import (
    illuminance_lx,
    illuminance_verdict,
    vertical_illuminance_lx,
)
from fieldlum.optics.photometry.shutter_law import (
    AUTO,
    EXACT,
    LAWS,
    PairRatio,
    ShutterLaw,
    law_of_frames,
    law_of_labels,
    time_under,
    times_under,
)
