"""The fitted model: fit, predict, and its arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.light import Facades, Features, Kernel, Light, light_features
from fieldlum.models import Patch, Prediction
from fieldlum.models.transport.physics import Physics, physics_of
from fieldlum.models.transport.pixel_fit import (
    SECOND_NOISE,
    PixelFit,
    Recipe,
    find_patch_gain,
    fit_pixels,
    hold_out_seasons,
    second_covariance,
    second_inverse,
    second_own,
)
from fieldlum.models.transport.selection import SelectedRecipe, choose_model
from fieldlum.models.transport.training_arrays import (
    LEAST_CDM2,
    Material,
    OpenSky,
    Patchwork,
    material_of,
)
from fieldlum.models.transport.uncertainty import (
    LOG10_E,
    SLIP_MSE,
    Trust,
    calibrate,
    experience,
    held_out_variance,
    log_sd,
    residual_noise,
    slip_variance,
)
from fieldlum.profiles import build, plain
from fieldlum.records import Progress, Room, quiet

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset

Array = NDArray[Any]

SAMPLE = 600  # pixels that say how far to believe the model, drawn by solid angle
HOURS_AT_ONCE = 64
LEAST_HOURS = 3
PHYSICS_ARRAYS = ("modes", "position", "axis", "sign", "share", "piece")


@dataclass(frozen=True)
class Transport:
    """A room's light transport. Pixel arrays run over the seen pixels; `train` are the captured
    hours' features.
    """

    shape: tuple[int, int]
    seen: NDArray[np.bool_]
    heading_deg: float
    kernel: Kernel
    train: Features
    train_light: Light
    projector: Array
    pixels: PixelFit
    open_sky: OpenSky
    patchwork: Patchwork | None
    patch_scale: float
    physics: Physics | None
    noise_dull: NDArray[np.floating]
    noise_sun: NDArray[np.floating]
    trust: Trust
    recipe: Recipe
    held_out_mse: Array | None = None
    table: tuple[dict[str, float], ...] = ()
    name: str = field(default="transport", init=False)

    @property
    def parameters(self) -> int:
        """Numbers held per pixel and per captured hour."""
        return int(
            self.pixels.b.size
            + self.pixels.second.size
            + 4 * len(self.pixels.scale)
            + self.projector.size
        )

    def predict(self, light: Light, patch_cdm2: NDArray[np.float32] | None = None) -> Prediction:
        """Maps of the hours of `light` without the sun's disc, [n, H, W]; work memory is bounded,
        the answer is not.

        patch_cdm2 [n, H, W]: direct sun on surfaces, without the disc; needed exactly when the
        model was fitted with patches. Raises InputError otherwise.
        """
        self._check(light, patch_cdm2)
        height, width = self.shape
        maps = np.zeros((len(light), height, width), np.float32)
        sd = np.zeros_like(maps)
        expected, trusted = np.empty(len(light)), np.empty(len(light), bool)
        for start in range(0, len(light), HOURS_AT_ONCE):
            rows = slice(start, start + HOURS_AT_ONCE)
            patch = None if patch_cdm2 is None or self.patchwork is None else patch_cdm2[rows]
            found = self._predict(light[rows], patch)
            maps[rows][:, self.seen], sd[rows][:, self.seen], expected[rows], trusted[rows] = found
        return Prediction(maps, sd, expected, trusted)

    def _check(self, light: Light, patch: NDArray[np.float32] | None) -> None:
        if self.patchwork is not None and patch is None:
            raise InputError(
                "the model",
                "was fitted with sun patches",
                "patches of the hours to predict",
                "give the site a [room], or train with --patch none",
            )
        if patch is not None and patch.shape != (len(light), *self.shape):
            wanted = f"{len(light)} x {self.shape[0]} x {self.shape[1]}"
            raise InputError(
                "sun patches",
                " x ".join(map(str, patch.shape)),
                wanted,
                "make them at the model's size",
            )

    def features(self, light: Light, patch: NDArray[np.float32] | None) -> Features:
        """What the kernel looks at in these hours."""
        features = light_features(light)
        if self.physics is not None:
            features = replace(features, bounced=self.physics.features(light))
        if self.patchwork is None or patch is None or self.recipe.below:
            return features
        return self.patchwork.add(features, patch, light, self.open_sky.mask(self.seen))

    def _predict(
        self, light: Light, patch: NDArray[np.float32] | None
    ) -> tuple[NDArray, NDArray, Array, NDArray]:
        """Maps and sd of the seen pixels [n, P], expected MSE and trust [n]."""
        features, pixels = self.features(light, patch), self.pixels
        cross = self.kernel(features, self.train)
        variance = self.trust.variance(cross, self.kernel.diagonal(features))
        total = light.total_lx.astype(np.float32)[:, None]
        scale = pixels.scale.astype(np.float32)
        surface = (cross @ self.projector).astype(np.float32) @ pixels.b.T
        np.maximum(surface, pixels.least.astype(np.float32), out=surface)
        surface *= total
        surface *= scale
        share: NDArray[np.floating] | float = 0.0
        if patch is not None:
            share = patch[:, self.seen] * (
                np.float32(self.patch_scale) * pixels.patch_gain.astype(np.float32)
            )
            surface += share
        where = self.open_sky.index
        surface[:, where] += pixels.sky_gain[where].astype(np.float32) * self.open_sky.luminance(
            light
        )
        near = (
            self._second(light, features)
            if len(pixels.second)
            else np.empty((len(light), 0), np.float32)
        )
        if len(pixels.second):
            surface *= np.exp(near @ pixels.second)
        luminance = np.maximum(surface, np.float32(LEAST_CDM2))
        share = share / luminance
        noise = self.noise_dull.astype(np.float32), self.noise_sun.astype(np.float32)
        doubt = self.trust.sun_doubt(features.beam, near)
        sd = log_sd(total * scale / luminance, share, variance, doubt, noise, self.trust.patch)
        sd *= (LOG10_E * self.trust.factor(features.beam, variance)).astype(np.float32)[:, None]
        expected = self.trust.mse * np.einsum(
            "ij,ij,j->i", sd, sd, self._weights(), dtype=np.float64
        )
        trusted = self.trust.trusted(variance)
        if self.recipe.second and self.held_out_mse is not None:
            known = self.train_light, self.train.beam, self.held_out_mse
            expected = experience(light, features.beam, *known, expected)
        if patch is not None and self.trust.slip_deg > 0.0:
            gain = np.float32(self.patch_scale) * pixels.patch_gain.astype(np.float32)
            dark = np.maximum(luminance * (1.0 - share), np.float32(LEAST_CDM2))
            slip_px = self.trust.slip_deg * self.shape[0] / 180.0
            slip = np.float32(LOG10_E**2) * slip_variance(patch, self.seen, gain, dark, slip_px)
            off = (slip @ self._weights()).astype(float)
            sd, expected, trusted = (
                np.sqrt(sd**2 + slip),
                expected + off,
                trusted & (off < SLIP_MSE),
            )
        return surface, sd, expected, trusted

    def doubting(self, slip_deg: float) -> Transport:
        """The same model, told that its sun patches lie so far beside the captured ones."""
        return replace(self, trust=replace(self.trust, slip_deg=slip_deg))

    def _second(self, light: Light, features: Features) -> NDArray[np.float32]:
        width = self.recipe.second
        return second_covariance(
            light, self.train_light, features.beam, self.train.beam, width
        ).astype(np.float32)

    def _weights(self) -> Array:
        from fieldlum.projection import equirect_solid_angles

        weights = equirect_solid_angles(*self.shape)[self.seen]
        return (weights / weights.sum()).astype(np.float32)

    # ------------------------------------------------------------------------------------------
    # state

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Settings for config.json and plain arrays for weights.npz."""
        kernel = {
            f.name: getattr(self.kernel, f.name) for f in fields(Kernel) if f.name != "facades"
        }
        config = {
            "heading_deg": self.heading_deg,
            "with_patch": self.patchwork is not None,
            "transport": {
                "kernel": kernel,
                "recipe": asdict(self.recipe),
                "patch_scale": self.patch_scale,
                "room": None if self.physics is None else plain(self.physics.room),
                "patchwork": None if self.patchwork is None else asdict(self.patchwork),
                "trust": {
                    name: getattr(self.trust, name)
                    for name in ("novelty", "patch", "mse", "slip_deg")
                },
                "tried": list(self.table),
            },
        }
        arrays: dict[str, NDArray[Any]] = {
            "seen": self.seen,
            "projector": self.projector,
            "noise_dull": self.noise_dull.astype(np.float32),
            "noise_sun": self.noise_sun.astype(np.float32),
            "facade_azimuths": self.kernel.facades.azimuths_deg,
            "facade_weights": self.kernel.facades.weights,
            "trust_inverse": self.trust.inverse,
            "trust_factors": self.trust.factors,
            "trust_variances": self.trust.variances,
            "trust_second": self.trust.second,
        }
        arrays |= {
            f"pixel_{f.name}": getattr(self.pixels, f.name).astype(np.float32)
            for f in fields(PixelFit)
        }
        arrays |= {f"sky_{f.name}": getattr(self.open_sky, f.name) for f in fields(OpenSky)}
        for f in fields(Features):
            value = getattr(self.train, f.name)
            if value is not None:
                arrays[f"train_{f.name}"] = value
        light = self.train_light
        arrays["train_sun"] = np.stack((light.sun_altitude_deg, light.sun_azimuth_deg))
        if self.physics is not None:
            arrays |= {f"physics_{name}": getattr(self.physics, name) for name in PHYSICS_ARRAYS}
            arrays["physics_norm"] = np.array(self.physics.norm)
        if self.held_out_mse is not None:
            arrays["held_out_mse"] = self.held_out_mse
        return config, arrays


def from_state(config: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Transport:
    """Inverse of `Transport.state`. Raises KeyError, TypeError or ValueError for what is missing
    or wrong.
    """
    own = config["transport"]
    facades = Facades(arrays["facade_azimuths"], arrays["facade_weights"])
    altitude, azimuth = arrays["train_sun"]
    nothing = np.zeros(len(altitude))
    times = (sun.datetime(2000, 1, 1, tzinfo=sun.UTC),) * len(altitude)
    train = Features(*(arrays.get(f"train_{f.name}") for f in fields(Features)))  # pyright: ignore[reportArgumentType]
    physics = None
    if own["room"] is not None:
        room = build(Room, own["room"], "the model's room")
        given = {name: arrays[f"physics_{name}"] for name in PHYSICS_ARRAYS}
        physics = Physics(room, **given, norm=float(arrays["physics_norm"]))
    known = {
        name: arrays[f"trust_{name}"] for name in ("inverse", "factors", "variances", "second")
    }
    trust = Trust(**{**own["trust"], **known})
    return Transport(
        shape=arrays["seen"].shape,  # pyright: ignore[reportArgumentType]
        seen=arrays["seen"],
        heading_deg=float(config["heading_deg"]),
        kernel=Kernel(facades, **own["kernel"]),
        train=train,
        train_light=Light(times, nothing, nothing, altitude, azimuth),
        projector=arrays["projector"],
        pixels=PixelFit(*(arrays[f"pixel_{f.name}"] for f in fields(PixelFit))),
        open_sky=OpenSky(*(arrays[f"sky_{f.name}"] for f in fields(OpenSky))),
        patchwork=None if own["patchwork"] is None else Patchwork(**own["patchwork"]),
        patch_scale=float(own["patch_scale"]),
        physics=physics,
        noise_dull=arrays["noise_dull"],
        noise_sun=arrays["noise_sun"],
        trust=trust,
        recipe=Recipe(**own["recipe"]),
        held_out_mse=arrays.get("held_out_mse"),
        table=tuple(own["tried"]),
    )


# ---------------------------------------------------------------------------------------------- fit


def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress = quiet,
) -> Transport:
    """Learn a room from captures in closed form; takes seconds, so that `budget_s` is never
    reached.

    patch "absolute": data.patch_cdm2 is in cd/m2; "gain": right up to one unknown factor; "none":
    not used. Raises NotEnoughDataError for fewer than three captures.
    """
    if len(data) < LEAST_HOURS:
        raise NotEnoughDataError(
            f"{len(data)} captures: light transport needs at least {LEAST_HOURS}"
        )
    if data.patch_cdm2 is None:
        patch = "none"
    progress(0, 100, "describing light")
    material = material_of(data, with_patch=patch != "none")
    kernel = Kernel(material.facades)
    scale = 1.0
    if patch == "gain":
        scale = find_patch_gain(material, kernel)
        material = material.with_patch_scaled(scale)
    progress(5, 100, "light between surfaces")
    physics = physics_of(data.setup, data.light)
    progress(10, 100, "choosing by held-out days")
    drawn = _draw(material, seed)
    chosen = choose_model(
        material[drawn], kernel, patch, None if physics is None else physics.features(data.light)
    )
    if chosen.features.bounced is None:
        physics = None
    material = replace(material, features=chosen.features)
    pixels = fit_pixels(
        material,
        chosen.basis,
        chosen.recipe,
        lambda done, total: progress(20 + 70 * done // total, 100, "fitting"),
    )
    progress(90, 100, "calibrating uncertainty")
    return _finish(data, material, chosen, pixels, drawn, scale, physics)


def _draw(material: Material, seed: int) -> NDArray[np.intp]:
    """Numbers of some pixels, by solid angle."""
    rng = np.random.default_rng(seed)
    count = min(SAMPLE, len(material.weights))
    return rng.choice(len(material.weights), count, p=material.weights / material.weights.sum())


def _finish(
    data: Dataset,
    material: Material,
    chosen: SelectedRecipe,
    pixels: PixelFit,
    drawn: NDArray[np.intp],
    scale: float,
    physics: Physics | None,
) -> Transport:
    """The model with its uncertainty, by the pixels `drawn`."""
    recipe, covariance, count = chosen.recipe, chosen.covariance, len(material.weights)
    model = Transport(
        shape=data.shape,
        seen=data.seen,
        heading_deg=data.heading_deg,
        kernel=chosen.kernel,
        train=material.features,
        train_light=data.light,
        projector=chosen.basis.projector,
        pixels=pixels,
        open_sky=material.open_sky,
        patchwork=material.patchwork,
        patch_scale=scale,
        physics=physics,
        noise_dull=np.zeros(count),
        noise_sun=np.zeros(count),
        trust=Trust(
            np.linalg.inv(covariance + recipe.noise * np.eye(len(covariance))),
            0.0,
            np.ones((1, 3)),
            np.ones((1, 3)),
            0.0,
            1.0,
            np.empty((0, 0)),
        ),
        recipe=recipe,
        held_out_mse=chosen.held.per_hour,
        table=tuple(
            {**asdict(r), "held_out_mse": e, "standard_error": se} for r, e, se in chosen.table
        ),
    )
    patch = None if material.patch is None else data.patch_cdm2
    parts = [
        model._predict(data.light[rows], None if patch is None else patch[rows])[0]
        for rows in (slice(i, i + HOURS_AT_ONCE) for i in range(0, len(data), HOURS_AT_ONCE))
    ]
    doubt = material.features.beam
    if recipe.second:
        noise = np.full(len(material.light), SECOND_NOISE)
        doubt = np.sqrt(held_out_variance(second_own(material, recipe), noise, material.days))
    residual = residual_noise(material, np.concatenate(parts), doubt)
    some = residual[0][drawn], residual[1][drawn]
    second = second_inverse(material, recipe)
    held = chosen.held, covariance, recipe.noise, some, doubt, second
    trust = calibrate(
        material[drawn], *held, apart=hold_out_seasons(material[drawn], chosen.basis, recipe)
    )
    return replace(model, noise_dull=residual[0], noise_sun=residual[1], trust=trust)
