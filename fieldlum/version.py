"""The version of the installed package, for provenance and `--version`."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("fieldlum")
except PackageNotFoundError:  # run from a bare checkout
    __version__ = "0+unknown"
