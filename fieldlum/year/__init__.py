"""Predict the hours of a year, and the glare of a map."""
