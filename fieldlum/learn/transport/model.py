"""Define the fitted transport model: its content, prediction and fit.

    L(t, p) = E(t) m(p) max(F(t) b(p), least(p)) + g(p) s(t, p) + h(p) Q(t, p)

See docs/models/transport.md for symbols, code names and units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.learn.models import ModelState, Patch, Prediction
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import HeldOutErrors
from fieldlum.learn.models.hour_weights import sun_is_unmeasured
from fieldlum.learn.transport.computed_light import computed_light
from fieldlum.learn.transport.features import (
    LEAST_CDM2,
    TrainingArrays,
    training_arrays_of,
    without_refuted,
)
from fieldlum.learn.transport.held_out import hold_out_seasons
from fieldlum.learn.transport.physics import physics_of
from fieldlum.learn.transport.pixel_fit import (
    Recipe,
    find_patch_gain,
    fit_pixels,
    second_inverse,
)
from fieldlum.learn.transport.response import LightBasis, RoomResponse, SurfaceMaps
from fieldlum.learn.transport.selection import SelectedRecipe, choose_model, plain_held_out
from fieldlum.learn.transport.stored import (
    TransportTable,
    arrays_of,
    response_of,
    table_of,
    uncertainty_of,
)
from fieldlum.learn.transport.uncertainty import (
    Uncertainty,
    calibrate,
    experience,
    residual_noise,
    seen_mse,
    sun_doubt,
)
from fieldlum.learn.transport.window_sky import SkyField, seen_sky
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.sky.light import Kernel, Light

# Number of pixels, drawn by solid angle, that choose the recipe and calibrate the uncertainty. Not
# measured.
SAMPLE = 600
HOURS_AT_ONCE = 64  # limits the memory of a prediction to some 100 MB at 460 x 230; chosen
LEAST_HOURS = 3  # least number of hours from which a kernel can be chosen; not measured


@dataclass(frozen=True)
class Transport:
    """A fitted light transport model.

    response: of the room's pixels to light; heading_deg: azimuth of the middle of the maps;
    uncertainty: of predictions; held_out_mse: log10 MSE of each capture, predicted from other days
    [captures], None if unknown; table: scores of the recipes that were tried; sky_field: how the
    skies in the windows differed from Perez's, None if the fit did not use them.
    """

    response: RoomResponse
    heading_deg: float
    uncertainty: Uncertainty
    held_out_mse: Array | None = None
    table: tuple[Mapping[str, float], ...] = ()
    sky_field: SkyField | None = None
    name: str = field(default="transport", init=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the maps [px]."""
        height, width = self.response.seen.shape
        return height, width

    @property
    def recipe(self) -> Recipe:
        """The recipe that held-out days chose."""
        return self.response.recipe

    @property
    def parameters(self) -> int:
        """Number of fitted values: those of the pixels, and the projector from captured hours."""
        pixels = self.response.pixels
        count = pixels.b.size + pixels.second.size + 4 * len(pixels.scale)
        return int(count + self.response.basis.projector.size)

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict luminance maps [n, H, W] of the n hours of `light`, with their uncertainty.

        Maps do not contain the sun's disc. patch_cdm2 [n, H, W]: luminance of direct sun on
        surfaces, without the disc; required if the model was fitted with sun patches, else not
        used. Only the result's memory grows with n. Raises InputError for required patches that
        are missing, or patches of another shape.
        """
        self._check(light, patch_cdm2)
        seen_mask, count = self.response.seen, len(light)
        maps = np.zeros((count, *self.shape), np.float32)
        sd = np.zeros_like(maps)
        expected, trusted = np.empty(count), np.empty(count, bool)
        with_patch = patch_cdm2 is not None and self.response.basis.patches is not None
        for start in range(0, count, HOURS_AT_ONCE):
            rows = slice(start, start + HOURS_AT_ONCE)
            patch = patch_cdm2[rows] if with_patch and patch_cdm2 is not None else None
            part = self.response.maps(light[rows], patch)
            maps[rows][:, seen_mask] = part.luminance
            sd[rows][:, seen_mask], expected[rows], trusted[rows] = self._belief(
                light[rows], part, patch
            )
        return Prediction(maps, sd, expected, trusted)

    def _belief(
        self, light: Light, maps: SurfaceMaps, patch: Floats32 | None
    ) -> tuple[Floats, Array, Mask]:
        """Return the sd of log10 L [n, P], the expected log10 MSE [n], and trusted [n]."""
        basis, recipe, unsure = self.response.basis, self.recipe, self.uncertainty
        features, luminance = maps.features, np.maximum(maps.luminance, np.float32(LEAST_CDM2))
        variance = unsure.variance(maps.cross, basis.kernel.diagonal(features))  # [n]
        share = 0.0 if maps.patch is None else maps.patch / luminance  # [n, P]
        sd = unsure.log10_sd(maps.unit / luminance, share, variance, features.beam, maps.second)
        weights = self._weights()
        expected = unsure.mse * np.einsum("ij,ij,j->i", sd, sd, weights, dtype=np.float64)
        trusted = unsure.trusted(variance)
        if recipe.second and self.held_out_mse is not None:
            captured = basis.captured_light, basis.captured.beam, self.held_out_mse
            expected = experience(light, features.beam, *captured, expected)
        if self.response.pixels.computed.any() and self.held_out_mse is not None:
            # Around computed light the kernel's variance is too small where captures are few.
            held_out = seen_mse(
                features.beam,
                sun_is_unmeasured(light, features.beam),
                basis.captured.beam,
                sun_is_unmeasured(basis.captured_light, basis.captured.beam),
                self.held_out_mse,
            )  # [n]
            wider = np.maximum(np.sqrt(held_out / expected), 1.0).astype(sd.dtype)
            sd, expected = sd * wider[:, None], np.maximum(expected, held_out)
        if patch is None or unsure.slip_deg <= 0.0:
            return sd, expected, trusted
        dark = np.maximum(luminance * (1.0 - share), np.float32(LEAST_CDM2))
        slip = unsure.slip_log10_variance(patch, self.response.seen, self.response.patch_gain, dark)
        off = (slip @ weights).astype(float)  # [n]
        return np.sqrt(sd**2 + slip), expected + off, trusted & unsure.slip_trusted(off)

    def _check(self, light: Light, patch: Floats32 | None) -> None:
        if self.response.basis.patches is not None and patch is None:
            raise InputError(
                "the model",
                "fitted with sun patches, but the hours to predict have no sun patches",
                "sun patches of these hours",
                "add [room] to the site, or train with --patch none",
            )
        if patch is not None and patch.shape != (len(light), *self.shape):
            raise InputError(
                "sun patches",
                f"an array of {' x '.join(map(str, patch.shape))}",
                f"{len(light)} x {self.shape[0]} x {self.shape[1]} (hours, height, width)",
                "compute the sun patches at the model's size",
            )

    def doubting(self, slip_deg: float) -> Transport:
        """Return the same model, with a larger uncertainty near the edges of sun patches.

        slip_deg: how far captured patches are displaced from computed ones [deg], as seen from the
        camera.
        """
        return replace(self, uncertainty=replace(self.uncertainty, slip_deg=slip_deg))

    def _weights(self) -> Array:
        """Return each seen pixel's share of the solid angle of all seen pixels, [P]."""
        weights = equirect_solid_angles(*self.shape)[self.response.seen]
        return (weights / weights.sum()).astype(np.float32)

    def state(self) -> ModelState:
        """Return settings for config.json and plain arrays for weights.npz."""
        arrays = arrays_of(self.response, self.uncertainty)
        if self.held_out_mse is not None:
            arrays["held_out_mse"] = self.held_out_mse
        config = {
            "heading_deg": self.heading_deg,
            "with_patch": self.response.basis.patches is not None,
            "transport": self._table(),
        }
        return ModelState(config, arrays)

    def _table(self) -> TransportTable:
        table = table_of(self.response, self.uncertainty, self.table)
        if self.sky_field is not None:
            table["sky_field"] = asdict(self.sky_field)
        return table


def from_state(state: ModelState) -> Transport:
    """Return the model that `Transport.state` described.

    Raises KeyError, TypeError or ValueError for missing or wrong content.
    """
    own: TransportTable = state.config["transport"]
    return Transport(
        response_of(own, state.arrays),
        float(state.config["heading_deg"]),
        uncertainty_of(own, state.arrays),
        state.arrays.get("held_out_mse"),
        tuple(own["tried"]),
        SkyField(**own["sky_field"]) if "sky_field" in own else None,
    )


# ----------------------------------------------------------------------------------------------
# fit


@threadpool_limits.wrap(limits=1, user_api="blas")  # its matrices are small; chunks run at once
def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress = quiet,
) -> Transport:
    """Fit a room's light transport to captures, in closed form.

    patch: "none" ignores the sun patches of `data`. With any other value, one factor on all patches
    is fitted, so that "absolute" (patches in cd/m2) and "gain" (patches known up to a factor) give
    the same model. seed: of the random draw of pixels that choose the recipe. budget_s: ignored.
    Raises NotEnoughDataError for fewer than three captures.
    """
    if len(data) < LEAST_HOURS:
        raise NotEnoughDataError(
            f"{counted(len(data), 'capture')}; light transport needs at least {LEAST_HOURS}; "
            "capture more hours"
        )
    with_patch = patch != "none" and data.patch_cdm2 is not None
    progress(0, 100, "describing light")
    arrays = training_arrays_of(data, with_patch=with_patch)
    kernel = Kernel(arrays.facades)
    scale = find_patch_gain(arrays, kernel) if with_patch else 1.0
    if with_patch:
        arrays = without_refuted(arrays.with_patch_scaled(scale), data)
    progress(5, 100, "light between surfaces")
    physics = physics_of(data.setup, data.light, data.heading_deg)
    progress(10, 100, "choosing by held-out days")
    drawn = _draw(arrays, seed)
    bounced = under_sky = None
    sky = seen_sky(arrays)
    if physics is not None:
        sunlight, window = physics.sunlight(data.light), arrays.open_sky.index
        bounced = physics.features(sunlight)
        perez = physics.luminance(data.light, sunlight, data.seen)
        arrays = replace(arrays, computed=computed_light(arrays, window, perez))
        if sky is not None:
            light = physics.luminance(data.light, sunlight, data.seen, sky.luminance_cdm2)
            under_sky = replace(computed_light(arrays, window, light), perez=perez)
    some = None if under_sky is None else under_sky[drawn]
    progress(12, 100, "choosing by held-out days")
    chosen = choose_model(arrays[drawn], kernel, bounced, sky, some)
    progress(20, 100, "fitting")
    light = arrays.computed if chosen.sky_field is None else under_sky
    arrays = replace(
        arrays,
        features=chosen.features,
        states=chosen.states,
        computed=light if chosen.computed else None,
    )
    pixels = fit_pixels(
        arrays,
        chosen.basis,
        chosen.recipe,
        lambda finished, total: progress(20 + 70 * finished // total, 100, "fitting"),
    )
    progress(90, 100, "calibrating uncertainty")
    kept = physics if chosen.computed or chosen.features.bounced is not None else None
    basis = LightBasis(
        chosen.kernel,
        arrays.features,
        data.light,
        chosen.basis.projector,
        kept,
        arrays.patches,
        arrays.states,
    )
    response = RoomResponse(data.seen, basis, pixels, arrays.open_sky, scale, chosen.recipe)
    return Transport(
        response,
        data.heading_deg,
        _uncertainty(response, data, arrays, chosen, drawn),
        chosen.held.per_hour,
        tuple({**asdict(r), "held_out_mse": e, "standard_error": se} for r, e, se in chosen.table),
        chosen.sky_field,
    )


def held_out_errors(data: Dataset) -> HeldOutErrors:
    """Return the errors of each capture by a fit without its day, of log10 luminance alone.

    It serves to compare two descriptions of the same captures: a plain recipe is faster than `fit`.
    """
    with_patch = data.patch_cdm2 is not None
    arrays = training_arrays_of(data, with_patch=with_patch)
    kernel = Kernel(arrays.facades)
    if with_patch:
        arrays = arrays.with_patch_scaled(find_patch_gain(arrays, kernel))
    return plain_held_out(arrays[_draw(arrays, seed=0)], kernel).errors


def _draw(arrays: TrainingArrays, seed: int) -> Indices:
    """Return indices of some pixels, drawn with probabilities by solid angle."""
    rng = np.random.default_rng(seed)
    count = min(SAMPLE, len(arrays.weights))
    return rng.choice(len(arrays.weights), count, p=arrays.weights / arrays.weights.sum())


def _uncertainty(
    response: RoomResponse,
    data: Dataset,
    arrays: TrainingArrays,
    chosen: SelectedRecipe,
    drawn: Indices,
) -> Uncertainty:
    """Calibrate the uncertainty by the held-out errors of the pixels `drawn`.

    The residuals of each pixel are included.
    """
    patch = None if arrays.patch is None else data.patch_cdm2
    fitted = [
        response.maps(data.light[rows], None if patch is None else patch[rows]).luminance
        for rows in (slice(i, i + HOURS_AT_ONCE) for i in range(0, len(data), HOURS_AT_ONCE))
    ]
    doubt = sun_doubt(arrays, chosen.recipe)  # [n]
    noise = residual_noise(arrays, np.concatenate(fitted), doubt)  # [P] each
    some = arrays[drawn]
    seasons = hold_out_seasons(some, chosen.basis, chosen.recipe)
    return calibrate(
        some,
        chosen,
        noise,
        (noise[0][drawn], noise[1][drawn]),
        doubt,
        second_inverse(arrays, chosen.recipe),
        seasons,
    )
