"""Run evalglare of pyradiance as a process, as the reference for fieldlum's glare.

evalglare is by J. Wienold, EPFL and Fraunhofer ISE. Its version and flags are reported with every
figure, because both change the result: the threshold in 2.05, the low-light correction in 2.14 and
3.05, the position index in 2.12 to 3.02.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import FieldlumError
from fieldlum.optics.images import radiance_program, write_radiance_hdr
from fieldlum.year.glare.fisheye import FISHEYE_VIEW

FLAGS = ("-b", "2000", "-C", "l-", "-d")  # threshold 2000 cd/m2, no low-light correction, detailed


@dataclass(frozen=True, slots=True)
class ReferenceGlare:
    """evalglare's figures of one picture; NaN for figures that its version does not print.

    dgp, dgi, ugr, ugp, cgi : its indices. ev_lx : vertical illuminance. background_cdm2 :
    background luminance. veiling_cdm2 : veiling luminance of Stiles and Holladay without the age
    term (evalglare's Lveil_cie). sources : number of glare sources. version, flags : of the
    evalglare that was run.
    """

    dgp: float
    ev_lx: float
    dgi: float
    ugr: float
    background_cdm2: float
    ugp: float
    cgi: float
    veiling_cdm2: float
    sources: int
    version: str
    flags: str


_NAMES = {  # of the figures in evalglare's output
    "dgp": "dgp",
    "ev_lx": "E_v",
    "dgi": "dgi",
    "ugr": "ugr",
    "background_cdm2": "lum_backg",
    "ugp": "ugp",
    "cgi": "cgi",
    "veiling_cdm2": "Lveil_cie",
}


@lru_cache(maxsize=1)
def reference_version() -> str:
    """Return the version text that evalglare prints."""
    shown = subprocess.run(
        [radiance_program("evalglare"), "-v"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    return (shown.stdout or shown.stderr).strip()


def reference_glare(picture_cdm2: Floats, *, view: str = FISHEYE_VIEW) -> ReferenceGlare:
    """Return evalglare's figures for a picture [H, W] in cd/m2.

    view : its view as Radiance's options, by default an equidistant 180-degree one. Raises
    FieldlumError if evalglare prints no figures.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "view.hdr"
        write_radiance_hdr(path, picture_cdm2, view=view)
        return reference_glare_of_file(path)


def reference_glare_of_file(path: Path) -> ReferenceGlare:
    """Return evalglare's figures for a .hdr picture on disk whose header states its VIEW.

    Raises FieldlumError if evalglare prints no figures.
    """
    process = subprocess.run(
        [radiance_program("evalglare"), *FLAGS, str(path)],
        capture_output=True,
        text=True,
        check=False,
    )
    return _parse(process.stdout, f"{process.stderr.strip()} (exit {process.returncode})")


def _parse(text: str, trouble: str) -> ReferenceGlare:
    """Parse the line ``dgp,av_lum,E_v,lum_backg,...: 0.34 ...`` and the number of sources."""
    line = next((line for line in text.splitlines() if line.startswith("dgp,")), "")
    names, _, figures = line.partition(":")
    row = dict(zip(names.split(","), figures.split(), strict=False))
    if "dgp" not in row:
        raise FieldlumError(
            f"evalglare printed no result: {trouble}; expected a line that begins with 'dgp,'; "
            "install pyradiance again"
        )
    head = text.split(maxsplit=1)[0]
    return ReferenceGlare(
        **{field: float(row.get(name, "nan")) for field, name in _NAMES.items()},
        sources=int(head) if head.isdigit() else 0,
        version=reference_version(),
        flags=" ".join(FLAGS),
    )
