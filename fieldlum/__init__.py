"""A camera, a pyranometer and a laptop on site: a year of luminance maps of a room."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("fieldlum")
except PackageNotFoundError:  # run from a bare checkout
    __version__ = "0+unknown"
