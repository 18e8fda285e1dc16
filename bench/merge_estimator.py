"""Bias, noise and coverage of the merge estimator on simulated brackets, against the Cramer-Rao
bound.

8 frames 2 EV apart, gain 4 e-/DN, read noise 6 e-, 14 bits, saturation at 15 000 DN below a tag of
16 383, nominal EXIF times that are wrong by up to 4 %. SNR is that of the longest frame, were it
not clipped.

    python bench/merge_estimator.py [--draws 200000]
"""

from __future__ import annotations

import argparse

import numpy as np

from fieldlum.merge.estimator import merge_signals
from fieldlum.merge.linear_frames import RawSignal
from fieldlum.merge.ratios import fit_ratios, pair_ratios, take_samples
from fieldlum.optics.exposure import prior_u_log, true_times_s

GAIN, READ_E, BLACK, SATURATION, WHITE = 4.0, 6.0, 512.0, 15000.0, 16383.0
NOMINAL_S = (13.0, 3.2, 0.8, 0.2, 1 / 20, 1 / 80, 1 / 320, 1 / 1250)
TRUE_S = (
    12.7,
    3.17,
    0.79,
    0.2,
    0.0493,
    0.0125,
    1 / 330,
    1 / 1330,
)  # and a shutter that is no ideal one either
PER_S = 300.0  # DN per second and cd/m2
SNRS = (0.2, 1.0, 5.0, 35.0, 84.0, 500.0, 2000.0, 8000.0)


def frame(light: np.ndarray, true_s: float, rng: np.random.Generator) -> np.ndarray:
    """Counts of one exposure: shot noise, read noise, quantisation, plateau below the tag."""
    electrons = rng.poisson(np.minimum(light * PER_S * true_s * GAIN, 1e9)) + rng.normal(
        0, READ_E, light.shape
    )
    return np.clip(np.round(electrons / GAIN + BLACK), 0, SATURATION).astype(np.uint16)


def signal(counts: np.ndarray, shutter_s: float) -> RawSignal:
    def constant(value: float) -> np.ndarray:
        return np.asarray(value, np.float32)

    full = constant(SATURATION - BLACK)
    noise = (READ_E / GAIN) ** 2 + 1 / 12
    return RawSignal(counts, constant(BLACK), full, constant(PER_S * shutter_s), GAIN, noise)


def bound(light: float) -> float:
    """Cramer-Rao bound of the standard deviation, from the frames that do not saturate."""
    total = 0.0
    for t in TRUE_S:
        y = light * PER_S * t
        if y < 0.97 * (SATURATION - BLACK):
            total += (PER_S * t) ** 2 / (y / GAIN + (READ_E / GAIN) ** 2 + 1 / 12)
    return 1 / np.sqrt(total)


def light_of_snr(snr: float) -> float:
    """Luminance whose longest frame would have this SNR."""
    noise2 = READ_E**2 + GAIN**2 / 12
    electrons = (snr**2 + np.sqrt(snr**4 + 4 * snr**2 * noise2)) / 2
    return electrons / (PER_S * TRUE_S[0] * GAIN)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    corrections = _ratios(rng)
    snapped = np.array([true_times_s(t) for t in NOMINAL_S])
    print(
        "nominal times, relative to the first:",
        _percent(np.array(NOMINAL_S) / TRUE_S / (NOMINAL_S[0] / TRUE_S[0])),
    )
    print(
        "after snapping:                     ",
        _percent(snapped / TRUE_S / (snapped[0] / TRUE_S[0])),
    )
    print(
        "after the fit:                      ",
        _percent(corrections / TRUE_S / (corrections[0] / TRUE_S[0])),
    )
    print(
        "| SNR | bias % | bias with fitted times % | noise / bound | coverage of 95 % interval % |"
    )
    print("|---|---|---|---|---|")
    width = 500
    shape = (options.draws // (2 * width), 2, width)
    for snr in SNRS:
        light = light_of_snr(snr)
        frames = [frame(np.full(shape, light), t, rng) for t in TRUE_S]
        rows = []
        for times in (TRUE_S, tuple(corrections / corrections[0] * TRUE_S[0])):
            signals = [signal(c, t) for c, t in zip(frames, times, strict=True)]
            rows.append(merge_signals(signals, shape))
        exact, fitted = rows
        error = exact.value_cdm2.astype(np.float64) / light - 1
        bias, standard = 100 * error.mean(), 100 * error.std() / np.sqrt(error.size)
        u = np.sqrt(exact.variance.astype(np.float64)) / light
        covered = 100 * np.mean(np.abs(error) <= 1.96 * u)
        least = bound(light) / light
        off = fitted.value_cdm2.astype(np.float64) / light - 1
        print(
            f"| {snr:g} | {bias:+.3f} (s.e. {standard:.3f}) | {100 * off.mean():+.3f} "
            f"| {error.std() / least:.4f} | {covered:.1f} |"
        )


def _ratios(rng: np.random.Generator) -> np.ndarray:
    """Times fitted from a scene of 18 stops (a smooth gradient) with nominal EXIF times."""
    light = np.repeat(np.exp(np.linspace(np.log(0.1), np.log(30000.0), 300)), 1000).reshape(
        300, 2, 500
    )
    times = [true_times_s(t) for t in NOMINAL_S]
    signals = [signal(frame(light, t, rng), s) for t, s in zip(TRUE_S, times, strict=True)]
    fit = fit_ratios(pair_ratios(take_samples(signals)), np.diag(prior_u_log(np.array(times)) ** 2))
    return np.array(times) * fit.correction


def _percent(ratio: np.ndarray) -> str:
    return " ".join(f"{100 * (r - 1):+.3f}" for r in ratio) + " %"


if __name__ == "__main__":
    main()
