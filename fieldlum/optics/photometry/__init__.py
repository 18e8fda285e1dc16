"""Compute with exposures and luminances: shutter times, responses, exposure ratios, vignetting."""

from fieldlum.optics.photometry.exposure import (
    SAME_SETTING_EV,
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
from fieldlum.optics.photometry.linearity import linearity_factor, rises
from fieldlum.optics.photometry.ratios import (
    PairRatio,
    RatioFit,
    fit_ratios,
    pair_ratio,
    prior_u_log,
)
from fieldlum.optics.photometry.response import (
    dark_floor,
    fit_response,
    monotone,
    polynomial_table,
    response_table,
    srgb_table,
)
from fieldlum.optics.photometry.shutter_law import (
    AUTO,
    EXACT,
    LAWS,
    ShutterLaw,
    law_of_frames,
    law_of_labels,
    time_under,
    times_under,
)
from fieldlum.optics.photometry.vignetting import check_vignetting, vignetting_at
