"""Describe sun and sky: where the sun is, what the sky gives, and what of it the camera sees."""
