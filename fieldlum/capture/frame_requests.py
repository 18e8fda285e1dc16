"""List the frames that a bracket needs, and write capture.json about those that were taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldlum.core.records import CameraSetup, Exposure, Slot
from fieldlum.session.files.capture_json import CaptureFile, interval_of
from fieldlum.session.ledger import SlotState
from fieldlum.session.tables import DeviceTable


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """One frame to take: its number in the bracket (from 0), its exposure, and the heading.

    heading_deg: clockwise from north; None without a turned head.
    """

    index: int
    exposure: Exposure
    heading_deg: float | None

    @property
    def stem(self) -> str:
        """File name without suffix: index, shutter time, heading and filter (``03_0.5s_h90``)."""
        turned = "" if self.heading_deg is None else f"_h{self.heading_deg:g}"
        return f"{self.index:02d}_{self.exposure.shutter_s:.6g}s{turned}" + (
            f"_{self.exposure.nd}" if self.exposure.nd else ""
        )


def shots(exposures: Sequence[Exposure], setup: CameraSetup) -> tuple[FrameRequest, ...]:
    """Return the frames of a bracket: all exposures at the first heading, then at the next."""
    headings: tuple[float | None, ...] = setup.headings or (None,)
    pairs = [(exposure, heading) for heading in headings for exposure in exposures]
    return tuple(FrameRequest(i, exposure, heading) for i, (exposure, heading) in enumerate(pairs))


def write_capture(
    folder: Path,
    slot: Slot,
    state: SlotState,
    setup: CameraSetup,
    camera: DeviceTable,
    *,
    complete: bool,
) -> None:
    """Write capture.json about a slot's frames into its folder, atomically, for merge.

    complete: whether all planned frames were taken; camera: what the camera reports about itself.
    Raises ValueError if the state has no frame.
    """
    frames = tuple(sorted(state.frames, key=lambda frame: frame.index))
    readings = state.illuminance_lx
    CaptureFile(
        slot.id,
        frames,
        *interval_of(frames),
        complete,
        setup.profile,
        setup.heading_deg,
        camera,
        sum(readings) / len(readings) if readings else None,
    ).write(folder / "capture.json")
