"""Sun position, seasons and components of sunlight, computed by pvlib. Naive times are refused."""

from fieldlum.optics.projection import direction  # callers read sun.direction
from fieldlum.sky.sun.components import (
    CLEAR_SUN_DEG,
    LOW_SUN_DEG,
    Irradiance,
    bsrn_limits,
    clearsky,
    closure_ratio,
    dhi_by_closure,
    dirint_dni,
    dni_by_closure,
    extraterrestrial_wm2,
    too_weak,
)
from fieldlum.sky.sun.days import (
    RISE_ALTITUDE_DEG,
    DayOfSun,
    clock_changes,
    declination_deg,
    rise_transit_set,
    season,
    standard_date,
    standard_midnight,
    standard_offset,
    standard_time,
    zone_off_sun_h,
)
from fieldlum.sky.sun.ephemeris import SUN_SOLID_ANGLE_SR, SunPosition, position, shown_altitude_deg
