"""Run a weather year through a trained model: hourly maps, their glare, and its classes."""

from fieldlum.year.predict.annual import Annual, read_annual, read_pictures
from fieldlum.year.predict.year import best_and_worst, newest_annual, outdated_text, run
