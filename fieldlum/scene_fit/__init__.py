"""A room's north, clock, pose, windows and furniture from its own captures."""
