"""Estimate where the camera sees the sky, and how much of the sun's beam arrives from there."""
