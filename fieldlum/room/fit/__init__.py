"""Fit a room's north, clock, pose, windows and furniture to its own captures."""
