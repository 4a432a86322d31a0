"""Pattern measures on height maps whose pattern is known."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.granular import PUBLISHED, THRESHOLDS, faultless_measures
from scenarios.patterns import CELLS, faultless_map, height_map, measure_pattern
from solvers.solution import Floats

SIDE = 100.0
# The window spreads a wave over neighboring angles of its shell, so that a perfect pattern has not Q = 1.
WINDOW = 0.1


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_stripes_have_q2_near_one(phase: float) -> None:
    found = measure_pattern(faultless_map(1, 5.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 5)
    assert found.q2 > 1.0 - WINDOW


@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_squares_have_q4_near_one_and_no_q2(phase: float) -> None:
    found = measure_pattern(faultless_map(2, 4.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 4)
    assert found.q4 > 0.8
    assert found.q2 < 0.1


@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_hexagons_have_q6_and_neither_q2_nor_q4(phase: float) -> None:
    found = measure_pattern(faultless_map(3, 6.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 6)
    assert found.q6 > 0.7
    # A shell of six waves holds few directions: turned out of the grid, the three waves do not weigh the same.
    assert found.q2 < 0.15
    assert found.q4 < 0.15


@pytest.mark.parametrize(("pattern", "named"), [("stripes", "Q2"), ("hexagons", "Q6")])
def test_a_faultless_pattern_passes_however_it_lies(pattern: str, named: str) -> None:
    least, most = faultless_measures(pattern, SIDE)[named]
    assert THRESHOLDS[pattern][named][0] < least < most <= 1.0


def test_three_waves_of_squares_pass_only_where_they_lie_well() -> None:
    least, most = faultless_measures("squares", SIDE)["Q4"]
    assert least < THRESHOLDS["squares"]["Q4"][0] < most
    # The panel of Bizon 1998 is one of those that do.
    assert least < PUBLISHED["squares"].q4 < most
    # Along the walls, where cos has its nodes or its peaks, and in larger boxes.
    along = measure_pattern(faultless_map(2, 3.0, 0.0), SIDE)
    assert along.q4 == pytest.approx(THRESHOLDS["squares"]["Q4"][0], abs=0.01)
    assert measure_pattern(faultless_map(2, 10.0, 0.0), SIDE).q4 > 0.95


@pytest.mark.parametrize(("directions", "turn"), [(1, 0.4), (2, 0.0), (2, 0.3), (2, 1.2), (3, 0.7)])
def test_the_turn_of_the_waves_is_found(directions: int, turn: float) -> None:
    found = measure_pattern(faultless_map(directions, 6.0, turn), SIDE).turns[2 * directions]
    period = np.pi / directions
    assert (found - turn + 0.5 * period) % period == pytest.approx(0.5 * period, abs=0.03)


@pytest.mark.parametrize("waves", [4.0, 4.4, 5.5, 7.3])
@pytest.mark.parametrize("directions", [1, 2, 3])
def test_a_wavelength_between_two_shells_is_found(directions: int, waves: float) -> None:
    found = measure_pattern(faultless_map(directions, waves, 0.3), SIDE)
    assert found.mean_wavelength == pytest.approx(SIDE / waves, rel=0.03)


def test_a_shift_of_a_wavelength_changes_nothing() -> None:
    here, there = (faultless_map(1, 4.0, 0.0, shift) for shift in (0.0, 1.0))
    assert there == pytest.approx(here, abs=1e-12)


def test_noise_has_no_pattern() -> None:
    found = measure_pattern(np.random.default_rng(0).standard_normal((CELLS, CELLS)), SIDE)
    assert found.share < 0.3
    assert max(found.q2, found.q4, found.q6) < 0.7


def test_a_flat_layer_is_not_divided_by_zero() -> None:
    found = measure_pattern(np.ones((CELLS, CELLS)), SIDE)
    assert found.roughness == 0.0
    assert (found.q2, found.q4, found.q6, found.skewness) == (0.0, 0.0, 0.0, 0.0)
    assert np.isnan([found.psi4, found.psi6]).all()


def peaks(place: Floats, width: float = 4.5) -> Floats:
    """A map with a rounded peak at each of some places, shape (peaks, 2)."""
    x, y = np.meshgrid(np.arange(CELLS) + 0.5, np.arange(CELLS) + 0.5, indexing="ij")
    return np.asarray(sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2.0 * width**2)) for a, b in place))


def lattice(bases: tuple[tuple[float, float], tuple[float, float]], turn: float, spacing: float) -> Floats:
    """Places of a lattice all over the floor, turned about its middle."""
    count = np.arange(-12, 13)
    place = spacing * np.stack(np.meshgrid(count, count), axis=-1).reshape(-1, 2) @ np.array(bases)
    across = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    found = place @ across + 0.5 * CELLS
    return np.asarray(found[((found > -5.0) & (found < CELLS + 5.0)).all(axis=1)])


TRIANGULAR = ((1.0, 0.0), (0.5, np.sqrt(0.75)))
SQUARE = ((1.0, 0.0), (0.0, 1.0))


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.7])
@pytest.mark.parametrize("high", [1.0, -1.0])
def test_peaks_and_cells_of_a_triangular_lattice_have_six_neighbors(turn: float, high: float) -> None:
    found = measure_pattern(high * peaks(lattice(TRIANGULAR, turn, 28.9)), SIDE)
    assert found.psi6 > 0.9
    assert found.psi4 < 0.2
    assert found.skewness * high > 1.0


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.7])
def test_peaks_of_a_square_lattice_have_four_neighbors(turn: float) -> None:
    found = measure_pattern(peaks(lattice(SQUARE, turn, 25.0)), SIDE)
    # Of the five peaks away from the walls, some have a neighbor that a wall cuts.
    assert found.psi4 > 0.65
    assert found.psi6 < 0.25


def test_peaks_at_random_have_no_order() -> None:
    random = np.random.default_rng(0)
    found = [measure_pattern(peaks(random.uniform(0.0, SIDE, (18, 2))), SIDE) for _ in range(40)]
    for name in ("psi4", "psi6"):
        assert np.nanmean([getattr(one, name) for one in found]) == pytest.approx(0.5, abs=0.05)


def test_defects_take_the_order_of_the_whole_and_leave_that_of_the_neighbors() -> None:
    # Two halves of a lattice, one of them turned: order everywhere, but no common direction.
    left, right = (lattice(TRIANGULAR, turn, 16.5) for turn in (0.0, np.pi / 6.0))
    both = np.concatenate([left[left[:, 0] < 0.5 * SIDE], right[right[:, 0] >= 0.5 * SIDE + 6.0]])
    found, whole = (measure_pattern(peaks(place, width=3.0), SIDE) for place in (both, left))
    assert found.q6 < 0.6 * whole.q6
    assert found.psi6 > 0.6 * whole.psi6
    assert found.psi4 < 0.5 * found.psi6


def test_waves_are_as_high_as_they_are_deep() -> None:
    assert measure_pattern(faultless_map(1, 5.0), SIDE).skewness == pytest.approx(0.0, abs=0.05)
    assert measure_pattern(faultless_map(2, 4.0), SIDE).skewness == pytest.approx(0.0, abs=0.05)


def test_peaks_on_a_line_have_no_triangles() -> None:
    found = measure_pattern(peaks(np.array([[20.0 * k, 50.0] for k in range(1, 5)])), SIDE)
    assert np.isnan([found.psi4, found.psi6]).all()


def test_empty_cells_take_the_median() -> None:
    heights = faultless_map(1, 5.0)
    heights[::7, ::11] = np.nan
    assert measure_pattern(heights, SIDE).q2 > 1.0 - WINDOW


def test_the_highest_surface_of_a_cell_counts() -> None:
    place = np.array([[0.5, 1.5, 2.0, 0.5], [0.6, 1.4, 3.0, 0.5], [100.2, -0.3, 1.0, 0.5]])
    heights = height_map(place, SIDE)
    assert heights[0, 1] == 3.5
    assert heights[CELLS - 1, 0] == 1.5
    assert np.isnan(heights).sum() == CELLS**2 - 2
