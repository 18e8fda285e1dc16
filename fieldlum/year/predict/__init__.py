"""Run a weather year through a trained model: hourly maps, their glare, and its classes."""

from fieldlum.year.predict.annual import Annual, read_annual, read_pictures
from fieldlum.year.predict.glare_summary import best_and_worst
from fieldlum.year.predict.year import run
