"""Places that many tests share."""

from fieldlum.core.records import Site

SEATTLE = Site("Seattle", 47.6, -122.3, "America/Los_Angeles")
