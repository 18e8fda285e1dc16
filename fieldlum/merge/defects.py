"""Find the sensor pixels to ignore.

These are the profile's bad pixels and, for raw cameras, isolated pixels whose frames contradict
each other while all neighbours of the same colour agree. Pixels of moving objects are kept.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Indices, Mask
from fieldlum.core.records import Flag
from fieldlum.merge.frames import Crop
from fieldlum.optics.profiles import CameraProfile


def good_pixels(profile: CameraProfile, crop: Crop, flags: NDArray[np.uint8]) -> Mask | None:
    """Return a mask [height, width] of the crop that is False at pixels to ignore.

    These are the profile's bad pixels and, for a raw camera, the pixels of `odd_pixels`. Return
    None if every pixel is good. flags: of the merged pixels of the crop, in the frames' shape.
    """
    places = [(y - crop.top, x - crop.left) for x, y in profile.sensor.bad_px]
    inside = [(y, x) for y, x in places if 0 <= x < crop.width and 0 <= y < crop.height]
    bad = np.array(inside, np.intp).reshape(-1, 2)
    if profile.camera.kind == "raw":
        bad = np.concatenate((bad, odd_pixels(flags.reshape(crop.height, crop.width))))
    if not len(bad):
        return None
    good = np.ones((crop.height, crop.width), bool)
    good[bad[:, 0], bad[:, 1]] = False
    return good


def odd_pixels(flags: NDArray[np.uint8]) -> Indices:
    """Return row and column [n, 2] of mosaic pixels at which alone the frames disagree.

    flags: [h, w] of the mosaic. At such a pixel the frames disagree (it has the flag MOTION), but
    at all eight neighbours of the same colour they agree. This happens at stuck pixels and through
    noise. A moving object covers more than one pixel.
    """
    import cv2

    pixels = [np.empty((0, 2), np.intp)]
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        moved = ((flags[row::2, column::2] & Flag.MOTION) > 0).view(np.uint8)
        if moved.any():
            around = cv2.boxFilter(
                moved, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
            pixels.append(2 * np.argwhere((moved > 0) & (np.asarray(around) == 1)) + (row, column))
    return np.concatenate(pixels)
