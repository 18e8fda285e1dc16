"""Does the stated uncertainty cover the truth?

The brackets are of cameras that differ from their profile within its uncertainties.

Each realisation draws a camera whose shutter times, filters, vignetting, colour coefficients, k,
lens flare and (JPEG) response differ from the profile by draws from exactly the uncertainties that
the profile states, lets it photograph a new random scene with shot noise, read noise and rounding,
merges the written files with the unchanged profile, and counts the pixels whose true luminance is
within 2 u of the map. In total, and with each part alone (the others neither drawn nor stated;
where noise is not the part, a raw sensor is nearly noiseless; JPEG codes always have theirs).

    python bench/merge_budget.py [--realisations 400] [--kind raw|headings|jpeg] [--only total]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from time import process_time

import numpy as np

from fieldlum.core.records import Exposure, Flag
from fieldlum.devices.simulated.camera import raw_counts
from fieldlum.merge import merge_sensor
from fieldlum.merge.estimator import Merged
from fieldlum.merge.linear_frames import Crop, lens_crop
from fieldlum.merge.project import blend, finished_map, u_of_edges, view_through
from fieldlum.merge.sensor_frames import SensorImage
from fieldlum.merge.shots import U_REPEAT, Shot, sorted_shots
from fieldlum.optics.camera_curves import response_table, vignetting_at
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.linear_light import lens_geometry, true_shutter_s
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Colour,
    Lens,
    NeutralDensity,
    Response,
    Scale,
    Sensor,
    ShutterTime,
    Vignetting,
    bracket_exposures,
)
from fieldlum.optics.projection import Equirect, angle_of_radius, lens_rays
from fieldlum.optics.raw.writing import write_dng, write_jpeg

PARTS = ("random", "ratios", "filter", "response", "vignetting", "colour", "k", "glare floor")
DIAL_S = (4.0, 1.0, 1 / 4, 1 / 15, 1 / 60, 1 / 250, 1 / 1000, 1 / 4000)
# shot and read noise of a good sensor, in codes; the file adds its own rounding and compression
JPEG_CODE_SIGMA = 0.5
RESPONSE_CODES = 60.0  # correlation length of a response's error


@dataclass(frozen=True)
class Set:
    """What is simulated: parts that are there, and how the camera looks round."""

    kind: str  # raw: two lenses; headings: one lens turned; jpeg: two lenses
    parts: tuple[str, ...]
    quality: int = 97  # of the JPEG files
    sensor_px: int = 64  # height; a lens's circle fills it

    @property
    def headings(self) -> tuple[float | None, ...]:
        return (0.0, 180.0) if self.kind == "headings" else (None,)


def profile_of(which: Set) -> CameraProfile:
    """A small camera whose stated uncertainties are those of the requested parts; the rest are
    zero.
    """
    has = which.parts.__contains__
    curve = (Vignetting(5.6, (1.0, 0.0, -0.10, 0.0, -0.25), 0.03 if has("vignetting") else 0.0),)
    px = which.sensor_px / 64
    one = Lens((32.4 * px, 31.7 * px), 30.0 * px, 200.0, vignetting=curve, name="front")
    two = replace(one, centre_px=(96.3 * px, 32.2 * px), azimuth_deg=180.0, name="back")
    lenses = (one,) if which.kind == "headings" else (one, two)
    jpeg = which.kind == "jpeg"
    if has("random"):
        sensor = Sensor(
            "RGGB",
            (512.0,) * 4,
            (15800.0,) * 4,
            16383.0,
            gain_e_per_dn=2.0,
            read_noise_e=6.0,
            linearity_u_rel=0.0,
        )
    else:
        sensor = Sensor(
            "RGGB",
            (512.0,) * 4,
            (65000.0,) * 4,
            65535.0,
            gain_e_per_dn=1e4,
            read_noise_e=1.0,
            linearity_u_rel=0.0,
        )
    known = () if has("ratios") else tuple(ShutterTime(t, snapped(t), 1e-6) for t in DIAL_S)
    filtered = NeutralDensity("nd3", (900.0, 1000.0, 1150.0), 0.02 if has("filter") else 0.0)
    tail = {} if jpeg else {"nd": ("nd3",), "nd_shutter_s": (1 / 60, 1 / 1000)}
    table = tuple(float(z) for z in response_table("srgb"))
    response = Response("table", table, table, table, u_rel=0.02 if has("response") else 0.0)
    return CameraProfile(
        CameraBody(
            "budget", "jpeg" if jpeg else "raw", len(lenses) * which.sensor_px, which.sensor_px
        ),
        lenses,
        Bracket(5.6, 100.0, DIAL_S, **tail),
        sensor,
        known,
        response if jpeg else Response(),
        Colour((0.45, 0.70, 0.12), u_rel=0.02 if has("colour") else 0.0),
        Scale(1.03, 0.02 if has("k") else 0.0),
        () if jpeg else (filtered,),
        glare_floor_rel=0.001 if has("glare floor") else 0.0,
    )


def snapped(dial_s: float) -> float:
    bare = CameraProfile(CameraBody("", "raw", 2, 2), (), Bracket(1.0, 100.0, ()))
    return true_shutter_s(dial_s, bare)[0]


# ---------------------------------------------------------------------------------------------- one
# camera's truth


def true_camera(
    profile: CameraProfile, shares: np.ndarray, rng: np.random.Generator
) -> CameraProfile:
    """The camera behind the profile. shares [n, 3]: what each colour gives to the luminance, over
    the scene.

    A colour's u_rel is the rms error of luminance over colours (that is how calibrate fits it), so
    the three coefficients' errors are drawn to give just that.
    """

    def bent(lens: Lens) -> Lens:
        v = lens.vignetting[0]
        error = error_of[lens.name] * v.u_rel / (1 - float(vignetting_at(v.coefficients, 1.0)))
        c = np.asarray(v.coefficients)
        factor = error * -c  # 1 + error (1 - V)
        factor[0] += 1 + error
        return replace(lens, vignetting=(replace(v, coefficients=tuple(np.convolve(c, factor))),))

    error_of = {lens.name: rng.normal() for lens in profile.lens}
    spread = profile.colour.u_rel / np.sqrt((shares**2).sum(axis=1).mean())
    y = tuple(np.asarray(profile.colour.y_from_rgb) * (1 + spread * rng.normal(size=3)))
    off = [(n, 1 + n.u_rel * rng.normal()) for n in profile.nd]
    nd = tuple(replace(n, factor_rgb=tuple(np.asarray(n.factor_rgb) * f)) for n, f in off)
    r = profile.response
    if r.red:
        z = tuple(
            float(v)
            for v in _bent_response(np.asarray(response_table(r.kind, r.red)), r.u_rel, rng)
        )
        r = replace(r, red=z, green=z, blue=z)
    return replace(
        profile,
        lens=tuple(bent(x) for x in profile.lens),
        colour=replace(profile.colour, y_from_rgb=y),
        nd=nd,
        response=r,
        scale=replace(profile.scale, k=profile.scale.k * (1 + profile.scale.u_rel * rng.normal())),
    )


def _bent_response(z: np.ndarray, u_rel: float, rng: np.random.Generator) -> np.ndarray:
    """A relative error of u_rel at every code, alike over some 60 codes; kept monotone."""
    codes = np.arange(256.0)
    alike = np.exp(-0.5 * ((codes[:, None] - codes) / RESPONSE_CODES) ** 2) + 1e-6 * np.eye(256)
    error = np.linalg.cholesky(alike) @ rng.normal(size=256)
    return np.maximum.accumulate(z * (1 + u_rel * error))


def scene(rays: np.ndarray, shape: np.ndarray, bright: float) -> np.ndarray:
    """Camera colours of directions, [..., 3]: four decades, smooth, with a bright spot of
    `bright` cd/m2.
    """
    waves = np.stack([np.sin(2.0 * rays @ s[:3] + s[3]) for s in shape], axis=-1)
    spot = np.exp(150.0 * (rays @ np.array([0.0, 0.94, 0.34]) - 1.0))
    light = np.exp(3.0 + 2.2 * waves[..., 0] + 1.8 * waves[..., 1]) + bright * spot
    return light[..., None] * np.exp(0.35 * waves[..., 2:5])


def sensor_picture(
    profile: CameraProfile, crop: Crop, turn: float, shape: np.ndarray, bright: float
) -> tuple:
    """Camera colours [h, w, 3] and vignetting [h, w] on the sensor."""
    size = (profile.camera.height_px, profile.camera.width_px)
    rows, columns = np.mgrid[0.5 : size[0], 0.5 : size[1]]
    light, shading = np.full((*size, 3), 0.01), np.ones(size)
    for lens in profile.lens:
        g = lens_geometry(lens, turn)
        inside = np.hypot(columns - g.centre_px[0], rows - g.centre_px[1]) <= 1.06 * g.radius_px
        r = np.hypot(columns - g.centre_px[0], rows - g.centre_px[1])[inside] / g.radius_px
        light[inside] = scene(lens_rays(g, columns[inside], rows[inside]), shape, bright)
        relative = angle_of_radius(g, np.minimum(r, 1.05)) / g.half_angle_rad
        shading[inside] = np.polynomial.polynomial.polyval(
            relative, lens.vignetting[0].coefficients
        )
    return light, shading


# ---------------------------------------------------------------------------------------------- one
# realisation


@dataclass(frozen=True)
class Outcome:
    """Of the pixels judged, [n]: error over stated u, true luminance, angle from the nearest
    axis.
    """

    pull: np.ndarray
    truth: np.ndarray
    beside: np.ndarray  # in the seam of two lenses


def realise(
    which: Set, profile: CameraProfile, folder: Path, target: Equirect, rng: np.random.Generator
) -> Outcome:
    shape = np.concatenate([rng.normal(size=(5, 3)), rng.uniform(0, 6, (5, 1))], axis=1)
    bright = 3e5 if profile.nd else 0.0
    crop, size = lens_crop(profile), (profile.camera.height_px, profile.camera.width_px)
    sample = scene(
        lens_rays(lens_geometry(profile.lens[0], corner_px=(crop.left, crop.top)), *_grid(size[0])),
        shape,
        bright,
    )
    shares = (
        sample * profile.colour.y_from_rgb / (sample @ profile.colour.y_from_rgb)[..., None]
    ).reshape(-1, 3)
    true = true_camera(profile, shares, rng)
    has_ratios = "ratios" in which.parts
    off = {t: float(np.exp(rng.normal() * true_shutter_s(t, profile)[1])) for t in DIAL_S}
    flare = abs(rng.normal()) * profile.glare_floor_rel
    shots, views = [], []
    for heading in which.headings:
        turn = 0.0 if heading is None else heading - 180.0
        light, shading = sensor_picture(true, crop, turn, shape, bright)
        views += _truth(light, shading, true, crop, turn, target)
        mean = _mean_colour(shape, bright, target)
        exposed = (light + flare * mean) * shading[..., None]
        for i, e in enumerate(
            bracket_exposures(profile.bracket, profile.nd[0].name if profile.nd else "")
        ):
            true_s = true_shutter_s(e.shutter_s, profile)[0] * (
                off[e.shutter_s] if has_ratios else 1.0
            )
            true_s *= np.exp(U_REPEAT * rng.normal())  # the merge always reckons with it
            path = folder / f"{i:02d}_{heading}"
            shots.append(
                Shot(_photograph(exposed, e, true_s, true, path, which.quality, rng), e, heading)
            )
    images = []
    for heading, group in groupby(sorted_shots(shots, profile), key=lambda s: s.heading_deg):
        turn_deg = 0.0 if heading is None else heading - 180.0
        images.append(merge_sensor(list(group), profile, turn_deg=turn_deg)[0])
    merged = [view_through(image, lens, target) for image in images for lens in profile.lens]
    result = finished_map(blend(merged), profile, target)
    # The truth through the merge's own blend: how lenses of other sharpness part a pixel is
    # geometry, judged elsewhere.
    true_views = [
        replace(m, luminance=v.luminance, rgb=v.rgb) for m, v in zip(merged, views, strict=True)
    ]
    truth = blend(true_views).luminance.reshape(target.shape)
    good = (result.flags & (Flag.CLIPPED_HIGH | Flag.BLOOM | Flag.OUTSIDE_LENS)) == 0
    light = result.luminance_cdm2.astype(float)
    edges = u_of_edges(
        light, (result.flags & Flag.OUTSIDE_LENS) == 0, target, profile
    )  # geometry too: merge_scene.py
    u = np.sqrt(np.maximum(result.u_cdm2.astype(float) ** 2 - edges**2, 1e-24))
    pull = (light - truth) / u
    return Outcome(pull[good], truth[good], _seam(views).reshape(target.shape)[good])


def _grid(height_px: int) -> np.ndarray:
    """12 x 12 sensor columns and rows within the first lens."""
    at = np.arange(8, 56, 4) * (height_px / 64)
    return np.stack(np.meshgrid(at, at, indexing="ij"))


def _mean_colour(shape: np.ndarray, bright: float, target: Equirect) -> np.ndarray:
    fine = Equirect(4 * target.height)
    rows, columns = (np.arange(n) + 0.5 for n in fine.shape)
    solid = fine.solid_angles()
    colours = scene(fine.rays(rows, columns), shape, bright)
    return (colours * solid[..., None]).sum(axis=(0, 1)) / solid.sum()


def _truth(light, shading, true: CameraProfile, crop: Crop, turn: float, target: Equirect) -> list:
    """What a perfect merge would show, through the same geometry: that is judged elsewhere."""
    part = (light * shading[..., None])[
        crop.top : crop.top + crop.height, crop.left : crop.left + crop.width
    ]
    if true.camera.kind == "raw":
        letters = np.array(list(true.sensor.cfa)).reshape(2, 2)
        which = np.tile(letters, (crop.height // 2, crop.width // 2))
        part = np.select([which == c for c in "RGB"], [part[..., i] for i in range(3)])
        part = part.reshape(crop.height // 2, 2, crop.width)
    blank = np.zeros(part.shape, np.uint8)
    exact = Merged(part.astype(np.float32), np.zeros(part.shape, np.float32), blank)
    sensor = SensorImage(exact, true, crop, turn, 5.6, np.zeros_like)
    return [view_through(sensor, lens, target) for lens in true.lens]


def _seam(views: Sequence) -> np.ndarray:
    return np.sum([v.coverage > 0.5 for v in views], axis=0) > 1


def _photograph(
    exposed, e: Exposure, true_s: float, true: CameraProfile, path: Path, quality: int, rng
) -> Path:
    s = true.sensor
    if true.camera.kind == "jpeg":
        z = exposed * z_per_cdm2(true_s, e.f_number, e.iso, true.scale.k)
        table = np.asarray(response_table("table", true.response.red)) + np.arange(256) * 1e-12
        codes = np.interp(z, table, np.arange(256.0)) + rng.normal(0, JPEG_CODE_SIGMA, z.shape)
        write_jpeg(
            path.with_suffix(".jpg"),
            np.clip(np.rint(codes), 0, 255).astype(np.uint8),
            e,
            quality=quality,
        )
        return path.with_suffix(".jpg")
    mosaic = np.empty(exposed.shape[:2], np.float32)
    for i, letter in enumerate(s.cfa):
        mosaic[i // 2 :: 2, i % 2 :: 2] = exposed[i // 2 :: 2, i % 2 :: 2, "RGB".index(letter)]
    counts = raw_counts(mosaic, true, replace(e, shutter_s=true_s), rng)
    write_dng(
        path.with_suffix(".dng"), counts, e, black_dn=s.black_dn, white_dn=s.white_dn, cfa=s.cfa
    )
    return path.with_suffix(".dng")


# ---------------------------------------------------------------------------------------------- the
# table


def run(which: Set, realisations: int, seed: int) -> tuple[Outcome, list[Outcome]]:
    """All pixels together, and each realisation's own."""
    profile, target = profile_of(which), Equirect(16)
    with tempfile.TemporaryDirectory() as name:
        found = [
            realise(which, profile, Path(name), target, np.random.default_rng([seed, number]))
            for number in range(realisations)
        ]
    return Outcome(
        *(np.concatenate([getattr(o, f) for o in found]) for f in ("pull", "truth", "beside"))
    ), found


def coverage(pull: np.ndarray) -> float:
    return 100 * float(np.mean(np.abs(pull) <= 2.0)) if pull.size else float("nan")


def row(name: str, everything: Outcome, each: Sequence[Outcome]) -> str:
    own = np.array([coverage(o.pull) for o in each])
    dark, light = np.quantile(everything.truth, (0.2, 0.8))
    parts = (everything.truth <= dark, everything.truth >= light, everything.beside)
    figures = " | ".join(f"{coverage(everything.pull[p]):.1f}" for p in parts)
    error = own.std() / np.sqrt(len(own))
    return f"| {name} | {coverage(everything.pull):.1f} ({error:.1f}) | {figures} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--realisations", type=int, default=400)
    parser.add_argument("--kind", choices=("raw", "headings", "jpeg"), default="raw")
    parser.add_argument("--only", choices=("total", *PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quality", type=int, default=97, help="of the JPEG files")
    parser.add_argument("--sensor-px", type=int, default=64, help="height of the sensor")
    options = parser.parse_args()
    there = [
        p for p in PARTS if p not in (("filter",) if options.kind == "jpeg" else ("response",))
    ]
    if options.kind == "jpeg":  # codes always have their noise
        rows = {
            "total": there,
            "random": ["random"],
            **{p: ["random", p] for p in there if p != "random"},
        }
    else:
        rows = {"total": there, **{p: [p] for p in there}}
    print("| part | within 2 u % (s.e.) | darkest fifth | brightest fifth | seam |")
    print("|---|---|---|---|---|")
    started = process_time()
    for name, parts in rows.items():
        if options.only in (None, name):
            which = Set(options.kind, tuple(parts), options.quality, options.sensor_px)
            print(row(name, *run(which, options.realisations, options.seed)), flush=True)
    print(f"{process_time() - started:.0f} CPU s")


if __name__ == "__main__":
    main()
