"""The picture of the live display in docs/capture.md, from a real run in simulated time.

python bench/capture_picture.py docs/pictures/capture-live.svg
"""

from __future__ import annotations

import io
import re
import sys
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from faulty_clock import FaultyClock  # pyright: ignore[reportMissingImports]
from rich.console import Console

from fieldlum import capture
from fieldlum.capture.runner import Live
from fieldlum.cli.capture_command import panel
from fieldlum.core.records import Site, SiteFile, Slot
from fieldlum.optics.profiles import bracket_exposures, load_camera_profile
from fieldlum.session import create_session

START = datetime(2027, 3, 20, 15, 30, tzinfo=UTC)


def main() -> None:
    site = Site("office", 47.6, -122.3, "America/Los_Angeles")
    bracket = bracket_exposures(load_camera_profile("").bracket)
    slots = [Slot(START + timedelta(hours=i), 30.0, 150.0, bracket) for i in range(11)]
    seen: list[Live] = []
    with tempfile.TemporaryDirectory() as folder:
        session = create_session(Path(folder) / "s", SiteFile(site), slots, {})
        _, options = capture.prepare(session, fast=True)
        nap = (START + timedelta(hours=3, minutes=40), "suspend", 3900.0)
        capture.run(
            session,
            "sim:office?seed=1",
            "sim:office?seed=1",
            clock=FaultyClock(START - timedelta(minutes=2), [nap]),
            options=options,
            watch=seen.append,
        )
    console = Console(record=True, width=66, file=io.StringIO())
    console.print(panel(seen[6], site))
    svg = console.export_svg(title="fieldlum capture office-2027")
    # The page needs no other file: the reader's own fixed-width font, none from the net.
    Path(sys.argv[1]).write_text(
        re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
