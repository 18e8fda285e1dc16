"""Merge the frames of a bracket to a luminance map with its uncertainty."""

from fieldlum.merge.bracket import MergeOptions, MergeResult, files_to_picture, merge_shots
from fieldlum.merge.sensor_frames import merge_sensor
from fieldlum.merge.shots import Shot, shots_of_files
from fieldlum.merge.stage import merging, run
