"""Weather years: strict readers that list every repair, and a synthetic year without a file."""

from __future__ import annotations

from fieldlum.weather.files import SHIPPED_SITE, SYNTHETIC, read_weather, shipped_seattle
from fieldlum.weather.year import TYPICAL_YEAR, Weather, synthetic_weather
