"""Options of a merge."""

from __future__ import annotations

from dataclasses import dataclass

from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import Equirect, Fisheye
from fieldlum.optics.projection.grids import Target

DEFAULT_HEIGHT = 230  # rows: 0.8 degrees a pixel (docs/design.md); chosen


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How brackets are merged.

    height: rows of the result [px]. projection: "equirect" (a panorama, twice as wide as high) or
    "fisheye" (a square picture along the first lens). fit: whether exposure ratios are estimated
    from the frames, instead of taken from the profile; None: for raw frames only. drop_moved:
    whether to exclude a frame from the pixels where it contradicts most other frames, because
    something moved there.
    """

    height: int = DEFAULT_HEIGHT
    projection: str = "equirect"
    fit: bool | None = None
    drop_moved: bool = False

    def target(self, profile: CameraProfile) -> Target:
        """Return the pixel grid of the result: a panorama, or a fisheye like the first lens."""
        if self.projection == "equirect":
            return Equirect(self.height)
        lens = profile.lens[0]
        return Fisheye(self.height, lens.full_angle_deg, lens)

    def fits(self, profile: CameraProfile) -> bool:
        """Return whether exposure ratios are estimated from this camera's frames."""
        return profile.camera.kind == "raw" if self.fit is None else self.fit
