"""Compute robust spreads, standard errors and the one-standard-error rule, for all stages."""

from collections.abc import Iterator

import numpy as np

from fieldlum.core.arrays import Array, ArrayLike, Floats, Mask

# Standard deviation of a normal distribution over its median absolute deviation: 1 / 0.6745.
MAD_TO_SIGMA = 1.4826
# Standard error of a median over that of a mean, for normal values: sqrt(pi / 2).
_MEDIAN_OVER_MEAN_ERROR = 1.2533


def robust_sigma(values: ArrayLike, centre: float | None = None) -> float:
    """Return 1.4826 times the median absolute deviation: the standard deviation of normal values.

    values: [n], any unit, which the result has too. centre: the value from which deviations are
    measured; None for the median of `values`. Up to half of the values may be gross errors
    (Rousseeuw and Croux, J. Am. Stat. Assoc. 88, 1993).
    """
    array = np.asarray(values, float).ravel()
    middle = np.median(array) if centre is None else centre
    return float(MAD_TO_SIGMA * np.median(np.abs(array - middle)))


def cauchy_weights(residual: Floats, half: Floats | float) -> Floats:
    """Return the weights [...] of residuals [...] in a fit: 1 for 0, near 0 for gross errors.

    A weight is 1 / (1 + (residual / half)^2) (Cauchy's, in Holland and Welsch, Commun. Stat. A6,
    1977). half: the residuals, in the same unit, whose weight is a half.
    """
    return 1.0 / (1.0 + (residual / half) ** 2)


def nan_percentiles(values: Floats, percent: tuple[float, ...]) -> Array:
    """Return k percentiles [k, ...] along the first axis of values [n, ...]; NaN are ignored.

    percent: [k], 0 to 100. Interpolates linearly between neighbours. The result equals that of
    numpy.nanpercentile, which is 100 times slower. A column that contains only NaN gives NaN.
    """
    ordered = np.sort(values, axis=0)  # NaN last
    last = np.maximum((~np.isnan(values)).sum(axis=0) - 1, 0)  # [...], index of the largest value
    percentiles = []
    for q in percent:
        position = last * (q / 100.0)
        below = np.floor(position).astype(np.intp)
        low, high = (
            np.take_along_axis(ordered, index[None], axis=0)[0]
            for index in (below, np.minimum(below + 1, last))
        )
        percentiles.append(low + (high - low) * (position - below).astype(values.dtype))
    return np.stack(percentiles)


def median_standard_error(sigma: float, count: int) -> float:
    """Return the standard error of the median of `count` normal values, in the unit of `sigma`.

    sigma: standard deviation of one value. The result is sqrt(pi / 2) sigma / sqrt(count), the
    limit for many values.
    """
    return float(_MEDIAN_OVER_MEAN_ERROR * sigma / np.sqrt(count))


def standard_error(values: Floats, groups: Array | None = None) -> float:
    """Return the standard error of the mean of `values`, [n]; NaN for one value or one group.

    groups [n]: values of one group (such as hours of one day) share their errors, and only the
    groups are independent. The error is then cluster-robust with Bessel's correction (Cameron and
    Miller, J. Human Resources 50, 2015, eq. 11 with a constant as the only regressor).
    """
    values = np.asarray(values, float)
    of_value = np.arange(len(values)) if groups is None else groups
    names, group = np.unique(of_value, return_inverse=True)
    if (count := len(names)) < 2:
        return float("nan")
    sums = np.bincount(group, weights=values - values.mean())  # [groups]
    return float(np.sqrt((sums**2).sum() * count / (count - 1)) / len(values))


def held_out_masks(groups: Array, parts: int) -> Iterator[Mask]:
    """Yield a mask [n] for each of `parts` tests, True for the values that the test holds out.

    groups [n]: group of each value, such as its day; a group is never divided. Test p, from 0,
    holds out the groups p, p + parts, p + 2 parts ... in sorted order. So each group is held out
    once, and neighbouring ones in different tests.
    """
    names = np.unique(groups)
    for part in range(parts):
        yield np.isin(groups, names[part::parts])


def is_no_worse(errors: Floats, best_errors: Floats) -> bool:
    """Return whether a model's mean held-out error is at most one standard error above the best's.

    This is the one-standard-error rule (Breiman et al., Classification and Regression Trees, 1984)
    for paired errors. errors, best_errors [n]: held-out errors of the model and of the best model,
    for the same data in the same order; less is better. The standard error is that of the mean of
    errors - best_errors: easy and difficult data are the same for both models, so that the spread
    of one model's errors does not describe the difference. With one value the standard error counts
    as 0.
    """
    difference = np.asarray(errors, float) - np.asarray(best_errors, float)
    return bool(difference.mean() <= np.nan_to_num(standard_error(difference)))
