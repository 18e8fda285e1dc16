"""Run a weather year through a trained model: hourly maps, their glare, and its classes."""

from __future__ import annotations

from fieldlum.predict.annual import Annual as Annual
from fieldlum.predict.annual import read_annual as read_annual
from fieldlum.predict.annual import read_pictures as read_pictures
from fieldlum.predict.glare_summary import best_and_worst as best_and_worst
from fieldlum.predict.year import run as run
