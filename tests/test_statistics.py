"""Statistics on cases small enough to be counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from harness.statistics import (
    bootstrap_band,
    compare_costs,
    cost_to_reach,
    data_profile,
    fit_power_law,
    performance_profile,
    performance_ratios,
    summarize,
)

# A handful of logarithms and exponentials; only their rounding may remain.
ROUNDING = 1e-12
FAILS = math.inf


def test_the_best_solver_of_a_problem_has_ratio_one() -> None:
    ratios = performance_ratios([[2.0, 1.0], [3.0, 12.0]])
    np.testing.assert_array_equal(ratios, [[2.0, 1.0], [1.0, 4.0]])


def test_the_best_is_taken_over_those_who_solve() -> None:
    np.testing.assert_array_equal(performance_ratios([[FAILS, 5.0, 10.0]]), [[FAILS, 1.0, 2.0]])


def test_a_problem_that_nobody_solves_has_infinite_ratios_and_stays_in_the_count() -> None:
    costs = [[1.0, 2.0], [FAILS, FAILS]]
    np.testing.assert_array_equal(performance_ratios(costs)[1], [FAILS, FAILS])
    np.testing.assert_array_equal(performance_profile(costs, [1.0, 2.0, 1e9, FAILS]),
                                  [[0.5, 0.0], [0.5, 0.5], [0.5, 0.5], [0.5, 0.5]])  # fmt: skip


def test_a_performance_profile_counts_problems_within_a_factor() -> None:
    # Ratios: A 1, 4, fails; B 2, 1, 1.
    costs = [[1.0, 2.0], [8.0, 2.0], [FAILS, 7.0]]
    profile = performance_profile(costs, [1.0, 2.0, 4.0])
    np.testing.assert_allclose(profile, [[1 / 3, 2 / 3], [1 / 3, 1.0], [2 / 3, 1.0]])


@given(arrays(np.float64, (6, 3), elements=st.sampled_from([0.5, 1.0, 2.0, 7.0, math.inf])))
def test_a_profile_rises_to_the_share_of_solved_problems(costs: np.ndarray) -> None:
    profile = performance_profile(costs, [1.0, 1.5, 3.0, 100.0])
    assert (np.diff(profile, axis=0) >= 0).all()
    np.testing.assert_allclose(profile[-1], np.isfinite(costs).mean(axis=0))


@given(arrays(np.float64, (5, 3), elements=st.floats(0.1, 10.0)), st.floats(0.1, 10.0))
def test_a_profile_does_not_depend_on_the_unit_of_time(costs: np.ndarray, factor: float) -> None:
    np.testing.assert_allclose(performance_ratios(factor * costs), performance_ratios(costs), rtol=ROUNDING)


@pytest.mark.parametrize("bad", [[[1.0, math.nan]], [[0.0, 1.0]], [[-1.0, 1.0]], [1.0, 2.0]])
def test_what_is_no_cost_is_refused(bad: list[object]) -> None:
    with pytest.raises(ValueError, match="costs must"):
        performance_ratios(bad)  # type: ignore[arg-type]


def test_a_profile_of_no_problem_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one problem"):
        performance_profile(np.empty((0, 2)), [1.0])


def test_a_data_profile_measures_each_problem_in_its_own_unit() -> None:
    # In units: A 10, 1; B fails, 5.
    profile = data_profile([[20.0, FAILS], [100.0, 500.0]], [2.0, 100.0], [1.0, 5.0, 10.0])
    np.testing.assert_array_equal(profile, [[0.5, 0.0], [0.5, 0.5], [1.0, 0.5]])


def test_a_unit_must_be_finite() -> None:
    with pytest.raises(ValueError, match="units must be finite"):
        data_profile([[1.0]], [math.inf], [1.0])


def test_between_two_points_cost_is_straight_in_log_log() -> None:
    # error 1e-2 at 1 s and 1e-6 at 100 s: two decades of error a decade of cost.
    reached = cost_to_reach([1e-2, 1e-6], [1.0, 100.0], [1e-2, 1e-3, 1e-4, 1e-6])
    np.testing.assert_allclose(reached, [1.0, 10**0.5, 10.0, 100.0], rtol=ROUNDING)


def test_an_error_that_no_point_reaches_is_not_reached() -> None:
    assert cost_to_reach([1e-2, 1e-6], [1.0, 100.0], [1e-7]).tolist() == [math.inf]
    assert cost_to_reach([], [], [1e-2]).tolist() == [math.inf]


def test_an_error_above_the_cheapest_point_costs_that_point() -> None:
    assert cost_to_reach([1e-4, 1e-6], [3.0, 100.0], [1e-2]).tolist() == [3.0]


def test_a_dearer_and_worse_point_changes_nothing() -> None:
    with_detour = cost_to_reach([1e-2, 1e-1, 1e-6], [1.0, 10.0, 100.0], [1e-3, 1e-4])
    np.testing.assert_array_equal(with_detour, cost_to_reach([1e-2, 1e-6], [1.0, 100.0], [1e-3, 1e-4]))


def test_failed_settings_are_left_out() -> None:
    errors, costs = [1e-2, math.nan, math.inf, 1e-8], [1.0, 2.0, 3.0, math.inf]
    assert cost_to_reach(errors, costs, [1e-2, 1e-8]).tolist() == [1.0, math.inf]


def test_an_exact_answer_is_not_interpolated_towards() -> None:
    assert cost_to_reach([1e-2, 0.0], [1.0, 5.0], [1e-12]).tolist() == [5.0]


def test_the_order_of_settings_does_not_matter() -> None:
    errors, costs, targets = np.array([1e-1, 1e-3, 1e-9]), np.array([1.0, 4.0, 9.0]), np.logspace(-2, -8, 7)
    np.testing.assert_array_equal(
        cost_to_reach(errors, costs, targets), cost_to_reach(errors[::-1], costs[::-1], targets)
    )


@given(
    st.lists(st.tuples(st.floats(1e-12, 1.0), st.floats(1e-3, 1e3)), min_size=1, max_size=8),
    st.floats(1e-12, 1.0),
)
def test_a_smaller_error_never_costs_less(points: list[tuple[float, float]], target: float) -> None:
    errors, costs = zip(*points, strict=True)
    easy, hard = cost_to_reach(errors, costs, [target, target / 10])
    assert hard >= easy * (1 - ROUNDING)


@pytest.mark.parametrize(("errors", "costs"), [([1.0], [1.0, 2.0]), ([-1.0], [1.0]), ([1.0], [0.0])])
def test_impossible_points_are_refused(errors: list[float], costs: list[float]) -> None:
    with pytest.raises(ValueError, match="errors"):
        cost_to_reach(errors, costs, [0.1])


def _mean(rows: np.ndarray) -> np.ndarray:
    mean: np.ndarray = rows.mean(axis=0)
    return mean


def test_a_band_of_equal_problems_has_no_width() -> None:
    low, high = bootstrap_band(np.full((4, 2), 3.0), _mean, seed=0, draws=50)
    np.testing.assert_array_equal(low, [3.0, 3.0])
    np.testing.assert_array_equal(high, [3.0, 3.0])


def test_a_seed_gives_the_same_band_again() -> None:
    rows = np.arange(10.0)[:, None]
    first, again = bootstrap_band(rows, _mean, seed=5), bootstrap_band(rows, _mean, seed=5)
    np.testing.assert_array_equal(first[0], again[0])
    assert not np.array_equal(first, bootstrap_band(rows, _mean, seed=6, draws=51))


def test_the_band_of_a_mean_is_about_that_of_the_normal_distribution() -> None:
    rows = np.random.default_rng(1).standard_normal((400, 1))
    low, high = bootstrap_band(rows, _mean, seed=2)
    # The resampled mean has standard deviation s / sqrt(n); 2000 draws give its quantiles to a tenth of the width.
    half = 1.96 * rows.std() / np.sqrt(rows.size)
    assert abs((high - low)[0] / (2 * half) - 1) < 0.1


def test_a_band_of_a_profile_stays_a_share() -> None:
    costs = np.array([[1.0, 2.0], [FAILS, 1.0], [3.0, FAILS], [FAILS, FAILS]])
    low, high = bootstrap_band(costs, lambda rows: performance_profile(rows, [1.0, 4.0]), seed=0, draws=200)
    assert (low >= 0).all()
    assert (high <= 1).all()
    assert (low <= performance_profile(costs, [1.0, 4.0])).all()
    assert (high >= performance_profile(costs, [1.0, 4.0])).all()


def test_ratios_keep_failures_apart() -> None:
    ratios = compare_costs([2.0, 8.0, FAILS, 1.0, FAILS], [1.0, 1.0, 1.0, FAILS, FAILS])
    assert ratios.geometric_mean == pytest.approx(4.0, rel=ROUNDING)
    assert (ratios.smallest, ratios.largest) == (2.0, 8.0)
    assert (ratios.both, ratios.first_fails, ratios.second_fails, ratios.neither) == (2, 1, 1, 1)
    # 0, 2, 8, ∞: the failures stand at the ends.
    assert ratios.median == 5.0


def test_where_the_first_mostly_fails_the_median_ratio_is_infinite() -> None:
    assert compare_costs([1.0, FAILS, FAILS], [1.0, 1.0, 1.0]).median == math.inf


def test_ratios_without_a_common_success_are_no_number() -> None:
    ratios = compare_costs([FAILS, FAILS], [FAILS, FAILS])
    assert math.isnan(ratios.geometric_mean)
    assert math.isnan(ratios.median)
    assert ratios.neither == 2


def test_a_power_law_is_found_again() -> None:
    sizes = np.array([300.0, 1000.0, 4000.0, 60000.0])
    law = fit_power_law(sizes, 3e-6 * sizes**1.27)
    assert law.exponent == pytest.approx(1.27, rel=ROUNDING)
    assert law.factor == pytest.approx(3e-6, rel=1e-10)
    assert law.high - law.low < 1e-9
    np.testing.assert_allclose(law.at(sizes), 3e-6 * sizes**1.27, rtol=1e-10)


def test_the_interval_of_three_points_is_students() -> None:
    # log2 costs 0, 1, 3 over log2 sizes 0, 1, 2: slope 3/2, residuals 1/6, -1/3, 1/6, s² = 1/6, s_slope = sqrt(1/12).
    law = fit_power_law([1.0, 2.0, 4.0], [1.0, 2.0, 8.0])
    half = stats.t.ppf(0.975, 1) * math.sqrt(1 / 12)
    assert law.exponent == pytest.approx(1.5, rel=ROUNDING)
    assert law.low == pytest.approx(1.5 - half, rel=1e-10)
    assert law.high == pytest.approx(1.5 + half, rel=1e-10)


def test_two_sizes_give_an_exponent_without_interval() -> None:
    law = fit_power_law([10.0, 100.0, 1000.0], [1.0, 10.0, FAILS])
    assert law.exponent == pytest.approx(1.0, rel=ROUNDING)
    assert law.points == 2
    assert math.isnan(law.low)


@pytest.mark.parametrize(
    ("sizes", "costs"), [([10.0], [1.0]), ([10.0, 10.0], [1.0, 2.0]), ([10.0, 20.0], [1.0, FAILS])]
)
def test_an_exponent_needs_two_sizes(sizes: list[float], costs: list[float]) -> None:
    with pytest.raises(ValueError, match="two different sizes"):
        fit_power_law(sizes, costs)


def test_repeats_are_median_minimum_and_interquartile_range() -> None:
    repeats = summarize([5.0, 1.0, 2.0, 3.0, 4.0])
    assert (repeats.median, repeats.minimum, repeats.spread, repeats.count) == (3.0, 1.0, 2.0 / 3.0, 5)
    assert summarize([2.0]).spread == 0.0


@pytest.mark.parametrize("bad", [[], [1.0, math.inf], [math.nan]])
def test_repeats_must_be_there_and_finite(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        summarize(bad)
