"""Describe the room: its geometry, its fit to the captures, and rooms that are simulated."""
