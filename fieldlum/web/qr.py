"""A QR code drawn with the characters of a terminal."""

from __future__ import annotations

import numpy as np


def qr_lines(text: str) -> list[str]:
    """Return a QR code as lines of half blocks, with the required margin.

    Light modules are drawn: print the lines in white on black.
    """
    import cv2

    code = np.asarray(cv2.QRCodeEncoder.create().encode(text)) > 127  # light modules are true
    code = np.pad(code, 2, constant_values=True)  # the encoder adds two of the four modules
    if len(code) % 2:
        code = np.pad(code, ((0, 1), (0, 0)), constant_values=True)
    words = {(True, True): "█", (True, False): "▀", (False, True): "▄", (False, False): " "}
    pairs = zip(code[0::2], code[1::2], strict=True)
    return ["".join(words[bool(a), bool(b)] for a, b in zip(*pair, strict=True)) for pair in pairs]
