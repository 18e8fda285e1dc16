"""Sun position, seasons, and the components of sunlight, by pvlib; naive times are refused."""

from fieldlum.projection import direction as direction  # callers read sun.direction
from fieldlum.sun.components import CLEAR_SUN_DEG as CLEAR_SUN_DEG
from fieldlum.sun.components import LOW_SUN_DEG as LOW_SUN_DEG
from fieldlum.sun.components import Irradiance as Irradiance
from fieldlum.sun.components import bsrn_limits as bsrn_limits
from fieldlum.sun.components import clearsky as clearsky
from fieldlum.sun.components import closure_ratio as closure_ratio
from fieldlum.sun.components import dhi_by_closure as dhi_by_closure
from fieldlum.sun.components import dirint_dni as dirint_dni
from fieldlum.sun.components import dni_by_closure as dni_by_closure
from fieldlum.sun.components import extraterrestrial_wm2 as extraterrestrial_wm2
from fieldlum.sun.components import too_weak as too_weak
from fieldlum.sun.days import RISE_ALTITUDE_DEG as RISE_ALTITUDE_DEG
from fieldlum.sun.days import DayOfSun as DayOfSun
from fieldlum.sun.days import clock_changes as clock_changes
from fieldlum.sun.days import declination_deg as declination_deg
from fieldlum.sun.days import rise_transit_set as rise_transit_set
from fieldlum.sun.days import season as season
from fieldlum.sun.days import standard_date as standard_date
from fieldlum.sun.days import standard_midnight as standard_midnight
from fieldlum.sun.days import standard_offset as standard_offset
from fieldlum.sun.days import standard_time as standard_time
from fieldlum.sun.days import zone_off_sun_h as zone_off_sun_h
from fieldlum.sun.ephemeris import SUN_SOLID_ANGLE_SR as SUN_SOLID_ANGLE_SR
from fieldlum.sun.ephemeris import SunPosition as SunPosition
from fieldlum.sun.ephemeris import position as position
from fieldlum.sun.ephemeris import shown_altitude_deg as shown_altitude_deg
