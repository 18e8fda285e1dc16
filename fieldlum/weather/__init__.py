"""Weather years: strict readers that list every repair, and a synthetic year without a file."""

from __future__ import annotations

from fieldlum.weather.files import SHIPPED_SITE as SHIPPED_SITE
from fieldlum.weather.files import SYNTHETIC as SYNTHETIC
from fieldlum.weather.files import read_weather as read_weather
from fieldlum.weather.files import shipped_seattle as shipped_seattle
from fieldlum.weather.year import TYPICAL_YEAR as TYPICAL_YEAR
from fieldlum.weather.year import Weather as Weather
from fieldlum.weather.year import synthetic_weather as synthetic_weather
