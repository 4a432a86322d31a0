"""Disturbances and the jump finder on toy laws whose answer is known; invariance and scale likewise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import metamorphic, robustness
from harness.checked import Solve
from harness.measurement import Score, Verdict
from harness.sweeps import chain
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Status
from solvers.solution import Floats

# A handful of sums and products of numbers near one.
ROUNDING = 1e-14
# The jump finder's last interval, doubled for the rounding of its place.
PLACE = 2 * robustness.JUMP_WIDTH

cradle = chain(np.array([1.0, 0.0, 0.0, 0.0]))


def law(velocity: Callable[[ImpactProblem], Floats]) -> Solve:
    """Make a toy law of a formula for v_post."""

    def solve(problem: ImpactProblem) -> ImpactSolution:
        return ImpactSolution(None, velocity(problem), Status.CONVERGED, 0, 0)

    return solve


def test_disturbances_are_as_fast_as_the_impact_and_come_in_opposite_pairs() -> None:
    directions = robustness.disturbances(cradle, np.random.default_rng(0), pairs=3)
    assert len(directions) == 6
    np.testing.assert_array_equal(directions[0], -directions[1])
    for direction in directions:
        assert abs(np.abs(cradle.J @ direction).max() - cradle.speed) <= ROUNDING


def test_disturbances_leave_immovable_bodies_alone() -> None:
    wall = ImpactProblem([0.0, 1.0], [[1.0, -1.0]], [0.0, 1.0])
    assert robustness.random_disturbance(wall, np.random.default_rng(0))[0] == 0.0


@pytest.mark.parametrize("place", [0.0, 1e-9, 1e-4, 0.03, 0.0999])
def test_the_jump_finder_finds_a_jump_where_it_is(place: float) -> None:
    direction = robustness.random_disturbance(cradle, np.random.default_rng(1))
    bump = np.array([0.0, 0.25, 0.0, 0.0])

    def jumping(problem: ImpactProblem) -> Floats:
        along = float((problem.v_pre - cradle.v_pre) @ direction / (direction @ direction))
        return 3.0 * problem.v_pre + (bump if along > place else 0.0)

    jump = robustness.find_jump(law(jumping), cradle, jumping(cradle), direction)
    assert abs(jump.size - 0.25) <= 1e-10
    assert abs(jump.place - place) <= PLACE
    assert jump.width <= robustness.JUMP_WIDTH


@settings(max_examples=20)
@given(st.floats(0.1, 1000.0))
def test_the_jump_finder_finds_none_in_a_steep_continuous_law(slope: float) -> None:
    steep = law(lambda problem: slope * problem.v_pre)
    direction = robustness.random_disturbance(cradle, np.random.default_rng(2))
    assert robustness.find_jump(steep, cradle, slope * cradle.v_pre, direction).size == 0.0


def test_the_lipschitz_estimate_of_a_linear_law_is_its_norm() -> None:
    directions = robustness.disturbances(cradle, np.random.default_rng(3), pairs=2)
    found = robustness.responses(
        law(lambda problem: 3.0 * problem.v_pre),
        cradle,
        3.0 * cradle.v_pre,
        directions,
        sizes=robustness.SIZES,
        along=4,
    )
    largest = 3.0 * max(float(np.abs(direction).max()) for direction in directions)
    # A response of 1e-8 is known to 16 digits of the velocities, eight of its own.
    assert robustness.lipschitz(found).value == pytest.approx(largest, rel=1e-7)
    assert robustness.largest_response(found).value == pytest.approx(0.1 * largest, rel=1e-7)


def test_qce_jumps_on_the_cradle_of_four_and_with_waiting_contacts_it_does_not() -> None:
    directions = robustness.disturbances(cradle, np.random.default_rng(4), pairs=40)
    sizes = {}
    for name in ("qce", "qce-defer"):
        solve = SOLVERS[name]().solve
        v_post = solve(cradle).v_post
        found = robustness.responses(solve, cradle, v_post, directions, sizes=(), along=0)
        sizes[name] = robustness.find_jump(solve, cradle, v_post, found.steepest).size
    assert sizes["qce"] > 0.1
    assert sizes["qce-defer"] == 0.0


# A plane of three discs, one striking the two others; every block of two is one disc.
_half = np.sqrt(0.75)
plane = ImpactProblem(
    np.ones(6),
    [[-_half, -0.5, _half, 0.5, 0.0, 0.0], [-_half, 0.5, 0.0, 0.0, _half, -0.5]],
    [1.0, 0.1, 0.0, 0.0, 0.0, 0.0],
)


def relations(solve: Solve) -> dict[str, Score]:
    """All gated relations of a law on the plane scene."""
    v_post = solve(plane).v_post
    rotation = metamorphic.random_rotation(np.random.default_rng(5), n=6, dofs_per_body=2)
    scores = [
        metamorphic.bystander(solve, plane, v_post),
        metamorphic.coordinates("mirror", solve, plane, v_post, [metamorphic.mirror(n=6, dofs_per_body=2)]),
        metamorphic.coordinates("rotation", solve, plane, v_post, [rotation]),
        *(metamorphic.scale(unit, (2.0**40, 2.0**-40), solve, plane, v_post) for unit in ("mass", "speed", "gap")),
    ]
    return {score.metric: score for score in scores}


def failures(solve: Solve) -> set[str]:
    return {metric for metric, score in relations(solve).items() if score.verdict is Verdict.FAIL}


@pytest.mark.parametrize("name", ["qce", "qce-defer"])
def test_a_law_of_the_contacts_alone_passes_every_relation(name: str) -> None:
    assert failures(SOLVERS[name]().solve) == set()


def _with_absolute_tolerance(problem: ImpactProblem) -> Floats:
    """QCE that leaves slow contacts alone: slow in meters a second."""
    return problem.v_pre if problem.speed < 1e-6 else SOLVERS["qce"]().solve(problem).v_post


SPOILED_LAWS: dict[str, tuple[Callable[[ImpactProblem], Floats], set[str]]] = {
    "an absolute tolerance": (_with_absolute_tolerance, {"speed scaled", "gap scaled"}),
    "a dependence on mass": (
        lambda p: p.v_pre + (1.0 + 1e-3 * min(1.0, p.W_diagonal.max())) * (SOLVERS["qce"]().solve(p).v_post - p.v_pre),
        {"mass scaled"},
    ),
    "a dependence on the number of bodies": (
        lambda p: SOLVERS["qce"]().solve(p).v_post * (1.0 + 1e-3 * p.n),
        {"body added"},
    ),
    "a preferred direction": (
        lambda p: SOLVERS["qce"]().solve(p).v_post + 1e-3 * p.speed * np.resize([1.0, 0.0], p.n),
        {"body added", "mirror", "rotation", "gap scaled"},
    ),
}


@pytest.mark.parametrize("spoil", SPOILED_LAWS)
def test_a_law_spoiled_in_one_way_fails_the_relations_that_it_breaks(spoil: str) -> None:
    formula, broken = SPOILED_LAWS[spoil]
    assert failures(law(formula)) == broken


@settings(max_examples=30)
@given(st.integers(0, 1000))
def test_changes_of_coordinates_change_no_relative_velocity_and_no_energy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turned = metamorphic.in_coordinates(plane, metamorphic.random_rotation(rng, n=6, dofs_per_body=2))
    contacts, velocities = metamorphic.random_renumbering(rng, m=2, n=6, dofs_per_body=2)
    other = metamorphic.renumbered(plane, contacts, velocities)
    np.testing.assert_allclose(turned.u_pre, plane.u_pre, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(turned.W.toarray(), plane.W.toarray(), rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(other.u_pre, plane.u_pre[contacts])
    assert abs(other.kinetic_energy(other.v_pre) - plane.kinetic_energy(plane.v_pre)) <= ROUNDING


def test_a_rotation_turns_without_mirroring() -> None:
    for seed in range(5):
        R = metamorphic.random_rotation(np.random.default_rng(seed), n=6, dofs_per_body=3).toarray()
        np.testing.assert_allclose(R @ R.T, np.eye(6), rtol=0, atol=ROUNDING)
        assert np.linalg.det(R[:3, :3]) > 0


def test_qce_changes_with_a_contact_entered_twice_as_measured() -> None:
    # v_A of three balls at va = 0.5, contact BC once, twice: -1.045820, -1.0366.
    problem = chain(np.array([0.5, 0.0, -1.0]))
    twice = metamorphic.duplicated(problem, 1, stiffness_share=1.0)
    assert twice.m == 3
    assert SOLVERS["qce"]().solve(twice).v_post[0] == pytest.approx(-1.0366, abs=5e-5)


def test_a_contact_entered_twice_keeps_its_total_stiffness_where_both_are_halved() -> None:
    problem = chain(np.array([0.5, 0.0, -1.0])).replace(stiffness=[1.0, 3.0])
    assert metamorphic.duplicated(problem, 1, stiffness_share=0.5).stiffness.tolist() == [1.0, 1.5, 1.5]
