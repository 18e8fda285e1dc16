"""Further lines in the header of a Radiance picture, as other programs write them."""

from pathlib import Path


def add_lines(path: Path, *lines: str) -> None:
    """Insert lines, without line ends, below the first line of the picture."""
    first, rest = path.read_bytes().split(b"\n", 1)
    path.write_bytes(b"\n".join([first, *(line.encode() for line in lines), rest]))
