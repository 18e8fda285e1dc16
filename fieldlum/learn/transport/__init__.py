"""Light transport: linear in sky and sun, so that a room is learnt in closed form.

    L(t, p) = E(t) m(p) max(F(t) b(p) + c(p) s'(t, p), minimum) + g(p) s(t, p) + h(p) Q(t, p)

See docs/models/transport.md for symbols, code names and units. The uncertainty of each predicted
pixel is calibrated on held-out days.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from datetime import UTC
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.progress import part_of_progress, progress, quiet, shown_by
from fieldlum.core.records import counted
from fieldlum.core.statistics import standard_error
from fieldlum.learn.models import ModelState, Patch, Prediction, deserialised, state_of
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import solve, training_arrays
from fieldlum.learn.transport.physics import Physics, physics_of
from fieldlum.learn.transport.training_arrays import MIN_CDM2, OpenSky, PatchLight, TrainingArrays
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.scene.sun_patches import sun_patches
from fieldlum.session.site_toml import site_from_table
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light
from fieldlum.sky.light_similarity import Features, Kernel

# Number of pixels, drawn by solid angle, that choose inputs and noise, and that calibrate the
# uncertainty. Not measured.
CHOOSING, CALIBRATING = 250, 600
# Relative variances of a captured value, from that of a camera to that of a room that changes; the
# second one compares inputs. Not measured.
NOISES = (3e-3, 1e-2, 3e-2)

# Largest share of the model of a fitted scene: held-out hours do not have the year's other suns. Of
# two models with errors of 0.6 times each other, three quarters lose 5 % (measured in three rooms
# of other renderers); a scene that is worse than the stated room loses half of its excess.
MAX_SHARE = 0.75
# Largest expected error without the stated room, over that with it, at which the room is not used:
# between the ratios of `_choose_with_or_without_room`. A larger limit drops rooms that help.
MAX_ROOMLESS_RATIO = 0.5


class SurfaceMaps(NamedTuple):
    """Predicted luminance of n hours at the P pixels the lens saw, and inputs of its uncertainty.

    luminance: without the sun's disc [n, P] cd/m2; patch: the part of `luminance` that is direct
    sun on surfaces, before the second stage [n, P] cd/m2, None without sun patches; unit: luminance
    of a surface of usual brightness: total light times the pixel's scale [n, P] cd/m2; features: of
    the hours; cross: kernel between the hours and the captured hours [n, captures].
    """

    luminance: Floats32
    patch: Floats | None
    unit: Floats32
    features: Features
    cross: Array


@dataclass(frozen=True)
class Transport:
    """A fitted light transport model.

    seen: mask [H, W], True at the P pixels that the lens saw; heading_deg: azimuth of the middle of
    the maps, clockwise from north; noise: relative variance of a captured value; kernel: covariance
    of hours; captured: features of the n captured hours; projector [n, r]: the r features of new
    hours are kernel(new, captured) @ projector; states: lamps with which captures are marked;
    open_sky: the window pixels; pixels: fitted values; uncertainty: of predictions; patch_scale:
    fitted factor on all sun patches, None if patches are not used; physics: the coarse room model,
    None without a box room; patch_light: how sun patches become features, None without patches and
    with `physics`.
    """

    seen: Mask
    heading_deg: float
    noise: float
    kernel: Kernel
    captured: Features
    projector: Array
    states: training_arrays.StateColumns
    open_sky: OpenSky
    pixels: solve.PixelFit
    uncertainty: Uncertainty
    patch_scale: float | None = None
    physics: Physics | None = None
    patch_light: PatchLight | None = None
    name: str = field(default="transport", init=False)

    @property
    def held_out_mse(self) -> Array:
        """MSE of log10 L of each capture, predicted from other days, [n]."""
        return self.uncertainty.error_of[: len(self.captured)]  # the tests by days come first

    @property
    def parameters(self) -> int:
        """Number of fitted values: those of the pixels, and the projector from captured hours."""
        count = sum(getattr(self.pixels, f.name).size for f in fields(solve.PixelFit))
        return int(count + self.projector.size)

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict luminance maps [n, H, W] cd/m2 of the n hours of `light`, with the sd of log10 L.

        Maps do not contain the sun's disc. patch_cdm2 [n, H, W]: luminance of direct sun on
        surfaces, without the disc; required if the model was fitted with sun patches, else not
        used. Only the result's memory grows with n. Raises InputError for required patches that
        are missing, or patches of another shape.
        """
        patch = self._required_patch(light, patch_cdm2)
        count = len(light)
        maps = np.zeros((count, *self.seen.shape), np.float32)
        sd = np.zeros_like(maps)
        expected, trusted = np.empty(count), np.empty(count, bool)
        for start in range(0, count, 64):  # some 100 MB at 460 x 230
            rows = slice(start, start + 64)
            part = self.maps(light[rows], None if patch is None else patch[rows])
            maps[rows][:, self.seen] = part.luminance
            sd[rows][:, self.seen], expected[rows], trusted[rows] = self._uncertainty_of(part)
        return Prediction(luminance_cdm2=maps, log10_sd=sd, expected_mse=expected, trusted=trusted)

    def _required_patch(self, light: Light, patch: Floats32 | None) -> Floats32 | None:
        """Return the sun patches `patch`, or None if the model does not use them.

        Raises InputError, as `predict`, for patches that are missing or of another shape.
        """
        if self.patch_scale is None:
            return None
        needed = (len(light), *self.seen.shape)
        if patch is None or patch.shape != needed:
            found = "no sun patches" if patch is None else f"sun patches {patch.shape}"
            remedy = "add [room] to the site, or train with --patch none"
            raise InputError("the hours to predict", found, f"sun patches {needed}", remedy)
        return patch

    def maps(self, light: Light, patch: Floats32 | None) -> SurfaceMaps:
        """Predict the luminance of n hours at the seen pixels, without the sun's disc.

        The terms are those of the formula at the top of this module. patch: luminance of direct sun
        on surfaces [n, H, W] cd/m2; None adds no direct sun. Last, the second stage corrects hours
        with a sun from nearly the direction of a captured one.
        """
        pixels, features, computed = self.pixels, self.states.features(light), None
        if self.physics is not None:
            sunlight = self.physics.sunlight(light)
            features = replace(features, bounced=self.physics.features(light, sunlight))
            computed = self.physics.luminance(light, sunlight, self.seen)
        elif self.patch_light is not None and patch is not None:
            window = self.open_sky.mask(self.seen)
            features = replace(features, bounced=self.patch_light.features(patch, light, window))
        cross = self.kernel(features, self.captured)  # [n, captures]
        unit = light.total_lx.astype(np.float32)[:, None] * pixels.scale
        surface = (cross @ self.projector).astype(np.float32) @ pixels.b.T  # [n, P]
        if computed is not None:
            surface += computed * pixels.computed_gain / unit
        luminance = np.maximum(surface, solve.MIN_SHARE) * unit  # [n, P] cd/m2
        direct = None
        if patch is not None and self.patch_scale is not None:
            direct = patch[:, self.seen] * (np.float32(self.patch_scale) * pixels.patch_gain)
            luminance += direct
        window = self.open_sky.index  # [k] of the P pixels
        luminance[:, window] += pixels.sky_gain[window] * self.open_sky.luminance(light)
        second = solve.second_covariance(features, self.captured).astype(np.float32)
        luminance *= np.exp(second @ pixels.second)
        return SurfaceMaps(luminance, direct, unit, features, cross)

    def _uncertainty_of(self, maps: SurfaceMaps) -> tuple[Floats, Array, Mask]:
        """Return the standard deviation of log10 L, the expected log10 MSE and the trusted hours.

        Their shapes are [n, P], [n] and [n] for `maps` of n hours at P pixels.
        """
        calibrated, features = self.uncertainty, maps.features
        luminance = np.maximum(maps.luminance, np.float32(MIN_CDM2))
        variance = calibrated.variance(maps.cross, self.kernel.diagonal(features))  # [n]
        second = calibrated.second_variance(features, self.captured)  # [n]
        of_patch = calibrated.patch * (0.0 if maps.patch is None else maps.patch / luminance)
        squared_sd = log10_variance(
            maps.unit / luminance, of_patch, variance, second, self.pixels.noise
        )  # [n, P]
        weights = equirect_solid_angles(*self.seen.shape)[self.seen]
        guess = squared_sd.astype(float) @ (weights / weights.sum())  # [n]
        distance = sun_distance_deg(features, self.captured)
        expected = calibrated.expected_mse(features, self.captured, guess, distance)
        factor = calibrated.band * np.sqrt(expected / np.maximum(guess, 1e-12))  # [n]
        sd = np.minimum(np.sqrt(squared_sd) * factor.astype(squared_sd.dtype)[:, None], 1.0)
        # A trusted hour is at most 1.5 times as far from the captures as any held-out day.
        return sd, expected, variance <= 1.5 * calibrated.novelty

    def state(self) -> ModelState:
        """Return settings for config.json and plain arrays for weights.npz (`state_of`)."""
        return state_of(self, self.patch_scale is not None)


@dataclass(frozen=True)
class MeanTransport:
    """The mean of the log maps of two models: of a fitted scene, and of the room as it was stated.

    Captures cannot always tell which is better under suns that they do not have. The squared error
    of the mean is at most the mean squared error of the two models, and less where the errors of
    the two differ. stated: without a room if the captures clearly contradict it; share: weight of
    the fitted model, 0 to 1; held_out_mse: log10 MSE of each capture, predicted from other days
    [n].
    """

    fitted: Transport
    stated: Transport
    share: float
    held_out_mse: Array
    name: str = field(default="transport", init=False)

    @property
    def parameters(self) -> int:
        """Number of fitted values of both models."""
        return self.fitted.parameters + self.stated.parameters

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict luminance maps [n, H, W] cd/m2 of the n hours of `light`, with the sd of log10 L.

        Maps are geometric means of those of the two models, without the sun's disc; trusted hours
        are those of `fitted`. patch_cdm2 [n, H, W] cd/m2: luminance of direct sun on the surfaces
        of the fitted scene; the patches of the stated room are computed. Raises InputError for
        required patches that are missing or of another shape.
        """
        fitted = self.fitted.predict(light, patch_cdm2)
        stated = self.stated.predict(light, self._stated_patches(light))
        share, other = self.share, 1.0 - self.share  # weights of the two models
        mean = fitted.luminance_cdm2**share * stated.luminance_cdm2**other  # geometric
        maps = (np.maximum(made.luminance_cdm2, MIN_CDM2) for made in (fitted, stated))
        gap = np.log10(np.divide(*maps))
        # root mean squared error and standard deviation of log10 L if both models erred alike
        rms = share * np.sqrt(fitted.expected_mse) + other * np.sqrt(stated.expected_mse)
        assert fitted.log10_sd is not None and stated.log10_sd is not None
        sd = share * fitted.log10_sd + other * stated.log10_sd
        weights = equirect_solid_angles(*gap.shape[1:])[self.fitted.seen]
        spread = np.average(gap[:, self.fitted.seen] ** 2, axis=1, weights=weights)
        # Half fits twelve rooms of other renderers best (docs/validation.md). For a share near 0 or
        # 1 it is less, because the other model hardly counts.
        part = 0.5 * min(share * other / (MAX_SHARE * (1.0 - MAX_SHARE)), 1.0)
        return Prediction(
            luminance_cdm2=mean.astype(np.float32),
            log10_sd=np.sqrt(sd**2 + part * gap**2).astype(np.float32),
            expected_mse=(1.0 - part) * rms**2 + part * spread,
            trusted=fitted.trusted,
        )

    def _stated_patches(self, light: Light) -> Floats32 | None:
        """Return the sun patches of the stated room, [n, H, W] cd/m2; None if its model uses none.

        They are computed from the geometry alone; `predict` of that model multiplies them by its
        fitted patch_scale.
        """
        stated = self.stated
        if stated.physics is None or stated.patch_scale is None:
            return None
        suns, lx, heading_deg = light.apparent_sun_direction, light.direct_lx, stated.heading_deg
        room, height = stated.physics.room, len(stated.seen)
        with shown_by(quiet):  # a prediction is a step of the work that shows progress
            return sun_patches(room, suns, lx, height=height, heading_deg=heading_deg)

    def state(self) -> ModelState:
        """Return settings for config.json and plain arrays for weights.npz (`state_of`)."""
        return state_of(self, True)  # with sun patches


def from_state(state: ModelState) -> Transport | MeanTransport:
    """Return the model that `Transport.state` or `MeanTransport.state` described.

    Raises KeyError, TypeError or ValueError for missing or wrong content. Shapes of arrays are not
    checked.
    """
    table = state.config["transport"]
    return deserialised(MeanTransport if "fitted" in table else Transport, table, state.arrays)


# ----------------------------------------------------------------------------------------------
# fit


class _FitInputs(NamedTuple):
    """One description of the n captures from which all pixels can be fitted.

    arrays: captures at all pixels, with the features of their light; covariance: kernel between the
    captures [n, n]; basis: its eigenvectors; perez: features of the captures under Perez's skies,
    which those of `arrays` can replace by the skies that windows showed.
    """

    arrays: TrainingArrays
    perez: Features
    covariance: Array
    basis: solve.Basis


def fit(data: Dataset, *, patch: Patch = "absolute", seed: int = 0) -> Transport | MeanTransport:
    """Fit a room's light transport to captures, in closed form.

    patch: "none" ignores the sun patches of `data`. With any other value, one factor on all patches
    is fitted, so that "absolute" (patches in cd/m2) and "gain" (patches known up to a factor) give
    the same model. With a fitted scene the model is a mean, because a scene is wrong in places. A
    stated room that captures clearly contradict is not used. seed: of the random draw of pixels
    that choose inputs and noise. Raises NotEnoughDataError for fewer than three captures,
    InputError for an impossible room.
    """
    stated = None if patch == "none" else _as_stated(data)
    if stated is None:
        return _fit_chosen(_choose_with_or_without_room(data, patch, seed))[0]

    with part_of_progress(0, 2):
        fitted, errors = _fit_chosen(_choose_inputs(_candidates_of(data, patch, seed)))
    with part_of_progress(1, 2):
        other, other_errors = _fit_chosen(_choose_with_or_without_room(stated, patch, seed))
    # The shares have the least squared held-out error; the first tests are of held-out days.
    gap = other_errors - errors
    best = float((other_errors * gap).sum() / max((gap**2).sum(), 1e-9))
    share = float(np.clip(best, 0.0, MAX_SHARE))
    mixed = share * errors + (1.0 - share) * other_errors  # of log10 luminance, [k, P]
    return MeanTransport(fitted, other, share, (mixed[: len(data)] ** 2).mean(axis=1))


def _as_stated(data: Dataset) -> Dataset | None:
    """Return the captures with the stated heading and room; None without a fitted scene."""
    if data.scene is None or data.scene["chosen"] != "fitted":
        return None
    setup = site_from_table(data.scene["stated"], data.source)
    stated = replace(data, setup=setup, heading_deg=data.scene["stated_heading_deg"], scene=None)
    return replace(stated, patch_cdm2=stated.patches(data.light))


def _choose_with_or_without_room(data: Dataset, patch: Patch, seed: int) -> _Chosen:
    """Return the inputs with the stated room, or those without it if they predict clearly better.

    A box can be worse than no room if it lacks, for example, a building in front of its windows.
    Clearly better: the geometric mean of the errors (log10 MSE) of held-out days and of held-out
    seasons is less than `MAX_ROOMLESS_RATIO` (0.5) times that with the room. In eight rooms of
    other renderers this ratio predicts that of the year's errors: it is 0.34 in one room, where the
    errors of the year have the ratio 0.35, and 0.8 to 1.8 in seven rooms, where those have 0.7 to
    1.8. Captures of one season leave held-out seasons untested, so the room is used. Sun patches
    are computed from the room and are omitted with it. data: the captures; patch: with "none" sun
    patches are not used; seed: of the draw of pixels that compare the inputs.
    """
    stated = _choose_inputs(_candidates_of(data, patch, seed))
    if data.setup.room is None or seasons(data.days).max() == 0:
        return stated
    roomless = replace(data, setup=replace(data.setup, room=None), patch_cdm2=None)
    with shown_by(quiet):
        candidates = _candidates_of(roomless, "none", seed)
    errors_of_days = [candidates.errors(inputs).mean() for inputs in candidates.inputs]
    # The error of held-out days must be smaller too; it needs no further fit, so it is first.
    if min(errors_of_days) >= stated.mse:
        return stated
    chosen = _choose_inputs(candidates)
    return chosen if chosen.expected_mse < MAX_ROOMLESS_RATIO * stated.expected_mse else stated


class _Candidates(NamedTuple):
    """The inputs of a fit among which held-out days choose, and what all of them share.

    data: the captures; drawn: indices of the pixels that compare the inputs, drawn by solid angle
    [CALIBRATING]; scale: fitted factor on all sun patches, and patch_light: how patches become
    features, both None without sun patches; physics: coarse room model, None without a box room.
    """

    data: Dataset
    inputs: list[_FitInputs]
    kernel: Kernel
    drawn: Indices
    scale: float | None
    physics: Physics | None
    patch_light: PatchLight | None

    def errors(
        self, inputs: _FitInputs, noise: float = NOISES[1], days: NDArray | None = None
    ) -> Array:
        """Return the log10 MSE of each held-out hour at the first CHOOSING `drawn` pixels, [n].

        Hours are weighted by `sureness` over its mean, so that the mean of the result is the error
        by which inputs are compared. Ranked by DGP, or without the hours of the largest errors,
        fits of a rendered room had up to three times the log10 MSE over a year. noise: relative
        variance of a captured value. days [n]: groups of hours that are held out together; None for
        the captures' days.
        """
        arrays = inputs.arrays[self.drawn[:CHOOSING]]
        arrays = arrays if days is None else replace(arrays, days=days)
        error = solve.hold_out(arrays, inputs.basis, noise).error
        return (error**2).mean(axis=1) * arrays.sureness / arrays.sureness.mean()


class _Chosen(NamedTuple):
    """The chosen one of the candidates, and the noise of its fit.

    mse: log10 MSE of held-out days; noise: relative variance of a captured value.
    """

    candidates: _Candidates
    inputs: _FitInputs
    mse: float
    noise: float

    @property
    def expected_mse(self) -> float:
        """Geometric mean of the log10 MSE of held-out days and of held-out seasons."""
        days = seasons(self.candidates.data.days)
        of_seasons = self.candidates.errors(self.inputs, self.noise, days)
        return float(np.sqrt(self.mse * of_seasons.mean()))


@threadpool_limits.wrap(limits=1, user_api="blas")  # its matrices are small; chunks run at once
def _candidates_of(data: Dataset, patch: Patch, seed: int) -> _Candidates:
    """Return the inputs of a fit to the captures `data` among which held-out days choose.

    All sun patches are multiplied by one factor fitted to the captures (`patch_scale`), because
    transmittance and reflectances of the stated room are guesses. In a box room with windows the
    coarse room model computes the light that the sun causes inside. Without that model the sun
    patches determine it: the sums of sun patches in cells of the map become the features `bounced`.

    patch: with "none" sun patches are not used; seed: of the draw of pixels that compare the
    inputs. Raises NotEnoughDataError for fewer than three captures.
    """
    if len(data) < 3:
        finding = f"{counted(len(data), 'capture')}; light transport needs at least 3"
        raise NotEnoughDataError(f"{finding}; capture more hours")
    progress(0, 100, "describing light")
    arrays = training_arrays.training_arrays_of(data, with_patch=patch != "none")
    scale = None
    if arrays.patch is not None:
        scale = solve.patch_scale(arrays)
        arrays = replace(arrays, patch=arrays.patch * np.float32(scale))
    kernel = Kernel(arrays.facades)
    progress(5, 100, "light between surfaces")
    physics, patch_light = physics_of(data.setup, data.heading_deg), None
    if physics is None and arrays.patch is not None and data.patch_cdm2 is not None:
        window = arrays.open_sky.mask(data.seen)
        patch_light = PatchLight.of(data.patch_cdm2, data.light, window)
        entered = patch_light.features(data.patch_cdm2, data.light, window)
        arrays = replace(arrays, features=replace(arrays.features, bounced=entered))
    inputs = _candidate_inputs(arrays, kernel, physics, data.seen)
    progress(10, 100, "choosing by held-out days")
    count, share = len(arrays.weights), arrays.weights / arrays.weights.sum()
    drawn = np.random.default_rng(seed).choice(count, min(CALIBRATING, count), p=share)
    return _Candidates(data, inputs, kernel, drawn, scale, physics, patch_light)


@threadpool_limits.wrap(limits=1, user_api="blas")
def _choose_inputs(candidates: _Candidates) -> _Chosen:
    """Choose the inputs and the noise with the smallest error on held-out days at some pixels.

    A lamp that is on in all hours must explain 30 % of the error and a standard error (rooms
    without one: at most 1 % and 0.3): as an input, it doubles the error of two or four days without
    a lamp. The smallest noise, with which errors of patches are learnt, is excluded with a scene,
    without patches, and for days of one season: held-out days, which have nearly the same suns as
    others, do not show these errors.
    """
    data, tried = candidates.data, [candidates.errors(inputs) for inputs in candidates.inputs]
    k = int(np.mean(tried, axis=1).argmin())
    best, errors = candidates.inputs[k], tried[k]
    # one more lamp, which is on in every hour not marked lamp=off
    states = replace(best.arrays.states, always=True)
    lamps = states.features(best.arrays.light).lamps
    features = replace(best.arrays.features, lamps=lamps)
    arrays = replace(best.arrays, states=states, features=features)
    lit = _fit_inputs(arrays, candidates.kernel, replace(best.perez, lamps=lamps))
    gain = errors - candidates.errors(lit)
    # one day has no standard error
    if gain.mean() > np.fmax(0.3 * errors.mean(), standard_error(gain, data.days)):
        best, errors = lit, errors - gain
    # Held-out days from one season, 20 degrees of solar declination, do not test other seasons.
    one_season = float(np.ptp(_declination_deg(data.days))) < 20.0
    omit_smallest = data.scene is not None or best.arrays.patch is None or one_season
    noises = NOISES[1:] if omit_smallest else NOISES
    tried = [errors if noise == NOISES[1] else candidates.errors(best, noise) for noise in noises]
    means = [float(hours.mean()) for hours in tried]
    k = int(np.argmin(means))
    return _Chosen(candidates, best, mse=means[k], noise=noises[k])


@threadpool_limits.wrap(limits=1, user_api="blas")
def _fit_chosen(chosen: _Chosen) -> tuple[Transport, Array]:
    """Fit all pixels to the chosen inputs; return the model and its held-out errors [k, P].

    The errors are those of k tests of `calibrate` at the P drawn pixels: log10 of predicted over
    captured luminance.
    """
    common, inputs, noise = chosen.candidates, chosen.inputs, chosen.noise
    arrays, basis = inputs.arrays, inputs.basis
    progress(20, 100, "fitting")
    pixels = solve.fit_pixels(
        arrays, basis, noise, lambda part, count: progress(20 + 70 * part // count, 100, "fitting")
    )
    progress(90, 100, "calibrating uncertainty")
    careful = common.scale is None or common.physics is not None
    sample, residual = arrays[common.drawn], pixels.noise[common.drawn]
    uncertainty, errors = calibrate(sample, basis, inputs.covariance, noise, residual, careful)
    fitted = Transport(
        seen=common.data.seen,
        heading_deg=common.data.heading_deg,
        noise=noise,
        kernel=common.kernel,
        captured=arrays.features,
        projector=basis.projector,
        states=arrays.states,
        open_sky=arrays.open_sky,
        pixels=pixels,
        uncertainty=uncertainty,
        patch_scale=common.scale,
        physics=common.physics,
        patch_light=common.patch_light,
    )
    return fitted, errors


def _fit_inputs(arrays: TrainingArrays, kernel: Kernel, perez: Features) -> _FitInputs:
    """Return the inputs of a fit to captures; perez: their features under Perez's skies."""
    covariance = kernel(arrays.features, arrays.features)
    basis = solve.basis_of(covariance, kernel(perez, arrays.features))
    return _FitInputs(arrays, perez, covariance, basis)


def _candidate_inputs(
    arrays: TrainingArrays, kernel: Kernel, physics: Physics | None, seen: Mask
) -> list[_FitInputs]:
    """Return the inputs among which held-out days choose.

    These are Perez's skies or, with at least four days, those that windows showed, each with and
    without the light of the stated room. arrays: of the captures; physics: model of that room, None
    without one; seen: pixels that a lens saw [H, W].
    """
    light, sunlight, perez = arrays.light, None, None
    if physics is not None:
        sunlight = physics.sunlight(light)
        bounced = physics.features(light, sunlight)
        arrays = replace(arrays, features=replace(arrays.features, bounced=bounced))
        perez = physics.luminance(light, sunlight, seen)
    # Fewer than four days do not show that other skies are better.
    sky = training_arrays.seen_sky(arrays) if len(np.unique(arrays.days)) >= 4 else None
    out = []
    for shown in (None,) if sky is None else (None, sky):
        under_sky = arrays if shown is None else arrays.under(shown)
        out.append(_fit_inputs(under_sky, kernel, arrays.features))
        if physics is not None and sunlight is not None and perez is not None:
            under = perez if shown is None else physics.luminance(light, sunlight, seen, shown)
            computed = training_arrays.computed_light(under_sky, under, perez)
            lit = replace(under_sky, computed=computed)
            out.append(out[-1]._replace(arrays=lit))
    return out


# ----------------------------------------------------------------------------------------------
# uncertainty


LOG10_E = float(np.log10(np.e))
# Angle from the nearest captured sun over which the error of held-out seasons replaces that of
# held-out days. In five rooms of another renderer expected and true errors of hours rank alike by
# .45 (.17 before), in nine others by .54 (.43); 4 or 12 degrees have more error in its mean.
SUN_DISTANCE_DEG = 8.0


def _declination_deg(days: NDArray) -> Array:
    """Return the sun's declination at the beginning of each day, [n]; days: dates [n]."""
    names, inverse = np.unique(days.astype("datetime64[s]"), return_inverse=True)
    return sun.declination_deg([day.replace(tzinfo=UTC) for day in names.tolist()])[inverse]


def seasons(days: NDArray) -> Indices:
    """Return the index of the season of each day, from 0, [n].

    Seasons are ordered by the sun's declination, lowest (northern winter) first. A gap of over 10
    degrees between the days' declinations separates two seasons. days: dates [n] (datetime64).
    """
    declination = _declination_deg(days)
    values = np.unique(declination)
    starts = values[1:][np.diff(values) > 10.0]
    return np.searchsorted(starts, declination, side="right")


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """The uncertainty of a model's predictions, calibrated on n captures with held-out days.

    inverse, second: inverse of the captures' covariance plus noise, in the first and in the second
    stage [n, n]; novelty: largest `variance` of a capture with its day held out; patch: relative
    standard deviation of a sun patch; band: factor on all standard deviations, so that
    1.645 of them on each side contain 90 % of the held-out errors; careful: True if errors grow
    away from captures by more than the variance shows: without sun patches, or with those of a
    stated or fitted room, which are wrong in places. In each of k tests a captured hour was
    predicted from the other days or, with captures of several seasons, from the other seasons;
    tested: index of that hour [k]; error_of: its log10 MSE [k]; guess_of: the estimate of this
    error before the correction of `expected_mse` [k].
    """

    inverse: Array
    second: Array
    novelty: float
    patch: float
    band: float
    tested: Indices
    error_of: Array
    guess_of: Array
    careful: bool = True

    def variance(self, cross: Array, own: Array) -> Array:
        """Return the variance of m hours that the captures do not explain, in kernel units, [m].

        cross: kernel between the hours and the captures [m, n]; own: prior variance of the hours
        [m].
        """
        return np.maximum(own - np.einsum("ij,ij->i", cross @ self.inverse, cross), 0.0)

    def second_variance(self, hours: Features, captured: Features) -> Array:
        """Return the variance of m hours that the second stage does not explain, [m].

        It includes the noise of one capture. The second stage corrects light of the sun; its
        variance is in units of (sun's share of the total light) squared. hours, captured: features
        of the m hours and of the n captures.
        """
        cross = solve.second_covariance(hours, captured)
        explained = np.einsum("ij,ij->i", cross @ self.second, cross)
        return np.maximum(hours.beam**2 - explained, 0.0) + solve.SECOND_NOISE

    def expected_mse(
        self, hours: Features, captured: Features, guess: Array, distance_deg: Array
    ) -> Array:
        """Return the log10 MSE to expect in m `hours`, [m]: `guess` [m], corrected by the tests.

        The factor is the errors of the tests divided by the guesses for the tests, each summed with
        more weight for tests with a similar share of sun. captured: features of the n captures;
        distance_deg: `sun_distance_deg` of the hours [m]. If `careful`, the result is at least the
        weighted mean error of the tests: that of held-out days where the sun is as in a capture,
        which approaches that of held-out seasons with the distance.
        """
        beam, n = captured.beam[self.tested], len(captured)
        # Hours with a tenth more or less sun are similar.
        weight = np.exp(-0.5 * ((hours.beam[:, None] - beam) / 0.1) ** 2) + 1e-9  # [m, k]
        expected = guess * (weight @ self.error_of) / (weight @ self.guess_of)
        if not self.careful:
            return expected
        # Of the k tests, the first n are of held-out days, the next n of held-out seasons.
        groups = [slice(start, start + n) for start in range(0, len(beam), n)]
        means = [weight[:, g] @ self.error_of[g] / weight[:, g].sum(axis=1) for g in groups]
        near = np.exp(-distance_deg / SUN_DISTANCE_DEG)
        return np.maximum(expected, means[0] ** near * means[-1] ** (1.0 - near))


def sun_distance_deg(hours: Features, captured: Features) -> Array:
    """Return the angle between the sun of each of m hours and the nearest captured sun, [m].

    Captures with less than a fifth of their light from the sun do not count; 180 without others.
    """
    suns = captured.direction[captured.beam > 0.2]
    cosine = np.max(hours.direction @ suns.T, axis=1, initial=-1.0)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def log10_variance(
    surface_share: Floats,
    patch_share: Floats | float,
    variance: Array,
    second: Array,
    noise: Floats32,
) -> Floats:
    """Return the variance of log10 L, before its correction by `Uncertainty.expected_mse`, [m, P].

    It is 1 at most, a factor of ten in L. m hours, P pixels.

    surface_share: luminance of a usual surface (total light times pixel scale) over L [m, P];
    patch_share: luminance of the sun patch over L [m, P] times its relative standard deviation, or
    0; variance, second: results of `Uncertainty.variance` and `second_variance` [m]; noise:
    `PixelFit.noise` [P].
    """
    dtype = surface_share.dtype
    of_ln = surface_share**2 * variance.astype(dtype)[:, None]  # variance of ln L
    of_ln += second.astype(dtype)[:, None] * noise**2 + patch_share**2
    # With more than a factor of ten, one pixel would dominate the hour's mean.
    return np.minimum(of_ln * dtype.type(LOG10_E**2), dtype.type(1.0))


def calibrate(
    arrays: TrainingArrays,
    basis: solve.Basis,
    covariance: Array,
    noise: float,
    residual: Floats32,
    careful: bool,
) -> tuple[Uncertainty, Array]:
    """Calibrate the uncertainty of a model on held-out days and, with several, held-out seasons.

    Return it with the errors of these k tests, log10 of predicted over captured luminance [k, P].

    arrays: n captures at P pixels; residual: their `PixelFit.noise` [P]; covariance: kernel between
    captures [n, n], basis: its features; noise: of the fit, variance of a target of weight 1;
    careful: see `Uncertainty`.
    """
    hour_noise = noise / arrays.sureness  # hours of unsteady light have less weight
    inverse, second = np.linalg.inv(covariance + np.diag(hour_noise)), solve.second_inverse(arrays)
    groups = [arrays.days, seasons(arrays.days)]
    tests = [
        _Test(
            solve.hold_out(replace(arrays, days=days), basis, noise),
            _held_out_variance(inverse, hour_noise, days),
            _held_out_variance(second, np.zeros(len(days)), days),
            _held_out_distance_deg(arrays.features, days),
        )
        for days in (groups if groups[1].max() > 0 else groups[:1])
    ]
    patch = max(_patch_sd(arrays, test.held) for test in tests)
    variances = [test.log10_variance(arrays, patch, residual) for test in tests]  # [n, P] each
    share = arrays.trust + 1e-9  # weight of each pixel in the mean of its hour
    share /= share.sum(axis=1)[:, None]
    guess = np.concatenate([(share * variance).sum(axis=1) for variance in variances])
    errors = np.concatenate([test.held.error for test in tests])
    out = Uncertainty(
        inverse=inverse,
        second=second,
        novelty=float(tests[0].variance.max()),
        patch=patch,
        band=1.0,  # replaced below: it needs `expected_mse`
        tested=np.tile(np.arange(len(covariance)), len(tests)),
        error_of=(errors**2).mean(axis=1),
        guess_of=guess,
        careful=careful,
    )
    features, rows = arrays.features, out.tested
    distance = np.concatenate([test.distance_deg for test in tests])
    expected = out.expected_mse(features[rows], features, guess, distance)
    # Each hour's variances are scaled to the error to expect; that of the irradiance is added.
    variance = np.concatenate(variances) * (expected / guess)[:, None]
    sd = np.sqrt(variance + LOG10_E**2 * arrays.unsure[rows, None])
    ratios = np.split(np.abs(errors) / sd, len(tests))  # [n, P] each
    # The larger one of days and seasons, because a year has other seasons than the captures.
    band = max(float(np.quantile(ratio[~arrays.filled], 0.9)) for ratio in ratios)
    # 90 % of a normal distribution are within 1.6449 standard deviations.
    return replace(out, band=band / 1.6449), errors


class _Test(NamedTuple):
    """n captured hours as predicted from other days or seasons.

    variance, second: variances of the hours in the first and in the second stage [n];
    distance_deg: from their sun to the nearest one of the other days or seasons [n].
    """

    held: solve.HeldOutFit
    variance: Array
    second: Array
    distance_deg: Array

    def log10_variance(self, arrays: TrainingArrays, patch: float, residual: Floats32) -> Floats:
        """Return the estimated variance of log10 L of the n hours at P pixels, [n, P].

        arrays: the captures; patch: relative standard deviation of a sun patch; residual:
        `PixelFit.noise` [P].
        """
        luminance = np.maximum(self.held.luminance, MIN_CDM2)
        unit = arrays.light.total_lx[:, None] * self.held.scale
        share = 0.0 if arrays.patch is None else patch * arrays.patch / luminance
        return log10_variance(unit / luminance, share, self.variance, self.second, residual)


def _held_out_variance(inverse: Array, hour_noise: Array, days: NDArray) -> Array:
    """Return the variance of each of n captures, predicted from other days, in kernel units, [n].

    inverse: of the covariance between captures plus their noise [n, n]; hour_noise: the part of
    this noise that the result does not contain [n]; hours of equal `days` are held out together.
    """
    variance = np.empty(len(days))
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        variance[rows] = np.diagonal(np.linalg.inv(inverse[np.ix_(rows, rows)])) - hour_noise[rows]
    return np.maximum(variance, 0.0)


def _held_out_distance_deg(captured: Features, days: NDArray) -> Array:
    """Return `sun_distance_deg` of n captures from those of other `days` [n], [n]."""
    distance = np.empty(len(days))
    for day in np.unique(days):
        rows = days == day
        distance[rows] = sun_distance_deg(captured[rows], captured[~rows])
    return distance


def _patch_sd(arrays: TrainingArrays, held: solve.HeldOutFit) -> float:
    """Return the relative standard deviation of a sun patch: that of held-out values.

    Compared are the values of which over 30 % are direct sun; with 20 of them or fewer it is 0.05.
    """
    if arrays.patch is None:
        return 0.0
    lit = (arrays.patch > 0.3 * np.maximum(held.luminance, MIN_CDM2)) & ~arrays.filled
    error = np.abs(held.error[lit]) / LOG10_E
    return float(np.quantile(error, 0.9) / 1.6449) if lit.sum() > 20 else 0.05
