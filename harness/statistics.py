"""Statistics of times, errors and failures, each written once; pure functions of arrays.

    performance profile   ρ_s(τ) = share of the problems with t_ps / min_s t_ps ≤ τ        Dolan & Moré 2002
    data profile          d_s(α) = share of the problems with t_ps / (unit of p) ≤ α       Moré & Wild 2009
    power law             t = c mᵅ, fitted as log t = log c + α log m by least squares

A failure is an infinite cost: the best of a problem is taken over those who solve it, a failure is in no share, and a
problem that nobody solves stays in the count. NaN is no cost at all and is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from solvers.solution import Floats

# Share of the resampled or repeated experiments whose result lies in a band or an interval.
LEVEL = 0.95
# Resamplings of a bootstrap: the ends of a 95 % band are then the 50th from either side, good to a tenth of its width.
DRAWS = 2000
# Two points give a slope and no idea of its error.
FEWEST_FOR_INTERVAL = 3


@dataclass(frozen=True)
class Repeats:
    """What repeated timings of one thing came to."""

    median: float
    minimum: float
    spread: float
    """Interquartile range over the median, dimensionless; 0 for a single repeat."""
    count: int


@dataclass(frozen=True)
class PowerLaw:
    """cost = factor · size^exponent."""

    exponent: float
    low: float
    """Lower end of the confidence interval of the exponent; NaN below three sizes."""
    high: float
    factor: float
    points: int

    def at(self, sizes: npt.ArrayLike) -> Floats:
        """Return the fitted cost at these sizes."""
        cost: Floats = self.factor * np.asarray(sizes, dtype=np.float64) ** self.exponent
        return cost


@dataclass(frozen=True)
class Ratios:
    """Costs of one solver over another's on the same problems."""

    geometric_mean: float
    """Over the problems that both solve; NaN without one."""
    smallest: float
    largest: float
    median: float
    """Over all problems that either solves: infinite where the first fails, 0 where the second does."""
    both: int
    """Problems that both solve."""
    first_fails: int
    """Problems that the second alone solves."""
    second_fails: int
    """Problems that the first alone solves."""
    neither: int
    """Problems that nobody solves: counted here, in no ratio."""


def summarize(times: npt.ArrayLike) -> Repeats:
    """Median, minimum and spread of repeated timings.

    Args:
        times: shape (repeats,), all finite.

    Raises:
        ValueError: there is none, or one is not finite.
    """
    values = np.asarray(times, dtype=np.float64)
    if values.size == 0 or not np.isfinite(values).all():
        raise ValueError("repeats must be finite numbers, at least one")
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    spread = float((high - low) / median) if median > 0 else 0.0
    return Repeats(float(median), float(values.min()), spread, int(values.size))


def performance_ratios(costs: npt.ArrayLike) -> Floats:
    """Cost over the best solver's on the same problem.

    Args:
        costs: shape (problems, solvers), > 0; infinite where a solver fails.

    Returns:
        Shape (problems, solvers), ≥ 1; infinite where a solver fails.

    Raises:
        ValueError: a cost is NaN, zero or negative.
    """
    values = _costs(costs, dimensions=2)
    best = values.min(axis=1, initial=np.inf, keepdims=True)
    # Where nobody solves the problem ∞/∞ is no number: everybody fails.
    ratios: Floats = np.divide(values, best, out=np.full_like(values, np.inf), where=np.isfinite(best))
    return ratios


def performance_profile(costs: npt.ArrayLike, factors: npt.ArrayLike) -> Floats:
    """Share of the problems that each solver solves within a factor of the best (Dolan & Moré 2002, Eq. 2.1).

    Args:
        costs: shape (problems, solvers), > 0; infinite where a solver fails.
        factors: τ ≥ 1, shape (factors,).

    Returns:
        ρ, shape (factors, solvers), in [0, 1].

    Raises:
        ValueError: a cost is NaN, zero or negative, or there is no problem.
    """
    return _shares(performance_ratios(costs), factors)


def data_profile(costs: npt.ArrayLike, units: npt.ArrayLike, budgets: npt.ArrayLike) -> Floats:
    """Share of the problems that each solver solves within a budget (Moré & Wild 2009, Eq. 2.8).

    The unit there is n + 1 function values, a simplex gradient; here it is whatever makes problems of different size
    comparable, such as one visit to each contact.

    Args:
        costs: shape (problems, solvers), > 0; infinite where a solver fails.
        units: cost of one unit of work on each problem, shape (problems,), > 0.
        budgets: α, in units, shape (budgets,).

    Returns:
        d, shape (budgets, solvers), in [0, 1].

    Raises:
        ValueError: a cost or a unit is NaN, zero or negative, or there is no problem.
    """
    unit = _costs(units, dimensions=1)
    if not np.isfinite(unit).all():
        raise ValueError("units must be finite")
    return _shares(_costs(costs, dimensions=2) / unit[:, None], budgets)


def cost_to_reach(errors: npt.ArrayLike, costs: npt.ArrayLike, targets: npt.ArrayLike) -> Floats:
    """Cost at which a sweep of settings first reaches each error, straight in log-log between the points around it.

    A point counts where it is better than all cheaper ones. Nothing is extrapolated: an error that the cheapest point
    reaches already costs what that point costs (an upper bound), and one that no point reaches is infinite. A point
    with error 0 has no logarithm; up to it the cost is its own.

    Args:
        errors: of each setting, shape (points,), ≥ 0; NaN or infinite where it failed.
        costs: of each setting, shape (points,), > 0; NaN or infinite where it failed.
        targets: errors to reach, shape (targets,), > 0.

    Returns:
        Costs, shape (targets,); infinite = not reached.

    Raises:
        ValueError: the shapes differ, or an error or a cost is negative.
    """
    error, cost = np.asarray(errors, dtype=np.float64), np.asarray(costs, dtype=np.float64)
    if error.shape != cost.shape or error.ndim != 1:
        raise ValueError(f"errors and costs must have one entry for each setting: {error.shape}, {cost.shape}")
    if (error < 0).any() or (cost <= 0).any():
        raise ValueError("errors must be ≥ 0 and costs > 0")
    solved = np.isfinite(error) & np.isfinite(cost)
    error, cost = error[solved], cost[solved]
    # Cheapest first; of equal costs the better one.
    order = np.lexsort((error, cost))
    error, cost = error[order], cost[order]
    better = error < np.minimum.accumulate(np.concatenate([[np.inf], error]))[: error.size]
    error, cost = error[better], cost[better]
    wanted = np.atleast_1d(np.asarray(targets, dtype=np.float64))
    return np.array([_first_reached(error, cost, target) for target in wanted])


def bootstrap_band(
    problems: npt.ArrayLike,
    statistic: Callable[[Floats], Floats],
    *,
    seed: int,
    draws: int = DRAWS,
    level: float = LEVEL,
) -> tuple[Floats, Floats]:
    """Band of a statistic over problems drawn anew with replacement (percentile bootstrap, Efron 1979).

    Args:
        problems: one row a problem, shape (problems, …).
        statistic: of as many rows; any shape.
        seed: of the drawing.
        draws: how many times it is drawn.
        level: share of the draws within the band.

    Returns:
        Lower and upper end, each of the statistic's shape.

    Raises:
        ValueError: there is no problem.
    """
    rows = np.asarray(problems, dtype=np.float64)
    if len(rows) == 0:
        raise ValueError("a bootstrap needs at least one problem")
    rng = np.random.default_rng(seed)
    found = np.stack([statistic(rows[rng.integers(len(rows), size=len(rows))]) for _ in range(draws)])
    # Shares of few problems come in steps: an end is one of the values that were drawn, never one between.
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2], axis=0, method="nearest")
    return low, high


def compare_costs(first: npt.ArrayLike, second: npt.ArrayLike) -> Ratios:
    """Compare two solvers on the same problems, failures included.

    Args:
        first: cost of the first solver, shape (problems,), > 0; infinite where it fails.
        second: of the second, on the same problems.

    Raises:
        ValueError: a cost is NaN, zero or negative, or the shapes differ.
    """
    a, b = _costs(first, dimensions=1), _costs(second, dimensions=1)
    if a.shape != b.shape:
        raise ValueError(f"both solvers must have a cost for each problem: {a.size} and {b.size}")
    a_solves, b_solves = np.isfinite(a), np.isfinite(b)
    both = a_solves & b_solves
    ratio = a[both] / b[both]
    extremes = np.concatenate(
        [ratio, np.full((~a_solves & b_solves).sum(), np.inf), np.zeros((a_solves & ~b_solves).sum())]
    )
    return Ratios(
        geometric_mean=float(np.exp(np.log(ratio).mean())) if ratio.size else math.nan,
        smallest=float(ratio.min()) if ratio.size else math.nan,
        largest=float(ratio.max()) if ratio.size else math.nan,
        median=_median(extremes),
        both=int(both.sum()),
        first_fails=int((~a_solves & b_solves).sum()),
        second_fails=int((a_solves & ~b_solves).sum()),
        neither=int((~a_solves & ~b_solves).sum()),
    )


def fit_power_law(sizes: npt.ArrayLike, costs: npt.ArrayLike, *, level: float = LEVEL) -> PowerLaw:
    """Fit cost = c · sizeᵅ by least squares in log-log, with the interval of α by Student's t.

    Args:
        sizes: shape (points,), > 0.
        costs: shape (points,), > 0; points with an infinite cost (failures) are left out.
        level: confidence of the interval.

    Raises:
        ValueError: fewer than two different sizes have a cost, or a number is NaN, zero or negative.
    """
    size, cost = _costs(sizes, dimensions=1), _costs(costs, dimensions=1)
    if size.shape != cost.shape:
        raise ValueError(f"sizes and costs must have one entry for each point: {size.size}, {cost.size}")
    solved = np.isfinite(cost)
    if np.unique(size[solved]).size < 2:
        raise ValueError("an exponent needs a cost at two different sizes at least")
    fit = stats.linregress(np.log(size[solved]), np.log(cost[solved]))
    points = int(solved.sum())
    half = math.nan
    if points >= FEWEST_FOR_INTERVAL:
        half = float(stats.t.ppf((1 + level) / 2, points - 2) * fit.stderr)
    exponent = float(fit.slope)
    return PowerLaw(exponent, exponent - half, exponent + half, float(np.exp(fit.intercept)), points)


def _costs(values: npt.ArrayLike, *, dimensions: int) -> Floats:
    """Check costs: positive, infinite for a failure, never NaN."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != dimensions:
        raise ValueError(f"costs must have {dimensions} dimensions, not shape {array.shape}")
    if np.isnan(array).any() or (array <= 0).any():
        raise ValueError("costs must be > 0, and infinite where a solver fails; NaN is neither")
    return array


def _shares(values: Floats, bounds: npt.ArrayLike) -> Floats:
    """Share of the rows that are finite and at most each bound, shape (bounds, columns)."""
    if len(values) == 0:
        raise ValueError("a profile needs at least one problem")
    limit = np.atleast_1d(np.asarray(bounds, dtype=np.float64))
    within = (values[None] <= limit[:, None, None]) & np.isfinite(values)[None]
    share: Floats = within.mean(axis=1, dtype=np.float64)
    return share


def _first_reached(error: Floats, cost: Floats, target: float) -> float:
    """Cost at one target; both arrays go from the cheapest and worst point to the dearest and best."""
    reached = np.flatnonzero(error <= target)
    if reached.size == 0:
        return math.inf
    k = int(reached[0])
    if k == 0 or error[k] == 0.0 or error[k] == target:
        return float(cost[k])
    part = math.log(error[k - 1] / target) / math.log(error[k - 1] / error[k])
    return float(cost[k - 1] * (cost[k] / cost[k - 1]) ** part)


def _median(values: Floats) -> float:
    """Median of numbers among which some are infinite; NaN of none."""
    if values.size == 0:
        return math.nan
    ordered = np.sort(values)
    low, high = ordered[(values.size - 1) // 2], ordered[values.size // 2]
    # 0 and ∞ have no middle; everything else has the usual one.
    return float(low if low == high else math.inf if math.isinf(high) else 0.5 * (low + high))
