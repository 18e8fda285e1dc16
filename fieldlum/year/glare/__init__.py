"""Compute glare in every direction around a panorama, and of single pictures."""
