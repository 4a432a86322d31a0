"""Pattern measures on height maps whose pattern is known."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.patterns import CELLS, height_map, measure_pattern
from solvers.solution import Floats

SIDE = 100.0
# The window spreads a wave over neighboring angles of its shell, so that a perfect pattern has not Q = 1.
WINDOW = 0.1


def waves(count: int, waves_across: float, phase: float = 0.0) -> Floats:
    """Sum of plane waves whose directions divide the half circle evenly."""
    x, y = np.meshgrid(np.arange(CELLS) + 0.5, np.arange(CELLS) + 0.5, indexing="ij")
    angles = phase + np.pi * np.arange(count) / count
    turns = 2.0 * np.pi * waves_across / CELLS
    total = np.zeros((CELLS, CELLS))
    for angle in angles:
        total += np.cos(turns * (np.cos(angle) * x + np.sin(angle) * y))
    return total


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_stripes_have_q2_near_one(phase: float) -> None:
    found = measure_pattern(waves(1, 5.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 5)
    assert found.q2 > 1.0 - WINDOW


@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_squares_have_q4_near_one_and_no_q2(phase: float) -> None:
    found = measure_pattern(waves(2, 4.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 4)
    assert found.q4 > 0.8
    assert found.q2 < 0.1


@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_hexagons_have_q6_and_neither_q2_nor_q4(phase: float) -> None:
    found = measure_pattern(waves(3, 6.0, phase), SIDE)
    assert found.wavelength == pytest.approx(SIDE / 6)
    assert found.q6 > 0.7
    # A shell of six waves holds few directions: turned out of the grid, the three waves do not weigh the same.
    assert found.q2 < 0.15
    assert found.q4 < 0.15


def test_noise_has_no_pattern() -> None:
    found = measure_pattern(np.random.default_rng(0).standard_normal((CELLS, CELLS)), SIDE)
    assert found.share < 0.3
    assert max(found.q2, found.q4, found.q6) < 0.7


def test_a_flat_layer_is_not_divided_by_zero() -> None:
    found = measure_pattern(np.ones((CELLS, CELLS)), SIDE)
    assert found.roughness == 0.0
    assert (found.q2, found.q4, found.q6) == (0.0, 0.0, 0.0)


def test_empty_cells_take_the_median() -> None:
    heights = waves(1, 5.0)
    heights[::7, ::11] = np.nan
    assert measure_pattern(heights, SIDE).q2 > 1.0 - WINDOW


def test_the_highest_surface_of_a_cell_counts() -> None:
    place = np.array([[0.5, 1.5, 2.0, 0.5], [0.6, 1.4, 3.0, 0.5], [100.2, -0.3, 1.0, 0.5]])
    heights = height_map(place, SIDE)
    assert heights[0, 1] == 3.5
    assert heights[CELLS - 1, 0] == 1.5
    assert np.isnan(heights).sum() == CELLS**2 - 2
