"""Generalized reflections: against an oracle, with few and with many violated contacts, packed and not, and bounds."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from scenarios.packs import sphere_pack
from solvers import ImpactProblem, Status, UnsupportedProblem, cone_projection
from solvers.boxed_lcp import project
from solvers.generalized_reflections import GeneralizedReflections
from solvers.lcp_qp import NewtonLcpNnls
from solvers.solution import Floats
from solvers.sphere_rows import RENUMBERED
from tests.random_problems import KINDS, make

# Tens of reflections, each with an inner natural map of 1e-13, on W whose smallest nonzero eigenvalue is above 0.01.
SAME_VELOCITY = 1e-9
# A reflection rounds each velocity by some ulps, at random.
ROUNDING = 1e-15


def chain(velocities: Floats) -> ImpactProblem:
    n = velocities.size
    J = sp.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
    return ImpactProblem(np.ones(n), J, velocities)


def reflected(problem: ImpactProblem, *, threshold: float) -> tuple[Floats, int]:
    """The law by its definition: the exact inelastic LCP on the violated contacts, twice its change, again."""
    v, count = problem.v_pre, 0
    while True:
        violated = np.flatnonzero(problem.J @ v < -threshold)
        if violated.size == 0:
            return v, count
        part = ImpactProblem(problem.inverse_mass, problem.J[violated], v, restitution=0.0)
        v = 2.0 * NewtonLcpNnls().solve(part).v_post - v
        count += 1


@pytest.mark.parametrize("kind", KINDS)
def test_reflections_are_those_of_the_definition(kind: str) -> None:
    for seed in range(10):
        problem = make(kind, seed)
        solution = GeneralizedReflections().solve(problem)
        v, count = reflected(problem, threshold=1e-10 * problem.speed)
        assert solution.status is Status.CONVERGED
        assert solution.iterations == count
        np.testing.assert_allclose(solution.v_post, v, atol=SAME_VELOCITY * problem.speed)


def test_a_search_near_the_last_reflection_finds_all_that_is_violated() -> None:
    # One ball in forty moves: fewer contacts are violated than would make every contact worth a look.
    velocities = np.zeros(400)
    velocities[::40] = np.random.default_rng(1).uniform(0.5, 1.0, 10)
    problem = chain(velocities)
    solution = GeneralizedReflections().solve(problem)
    v, count = reflected(problem, threshold=1e-10 * problem.speed)
    assert solution.iterations == count
    np.testing.assert_allclose(solution.v_post, v, atol=SAME_VELOCITY)


@pytest.mark.kernels
def test_a_pulse_costs_the_same_at_every_step_however_long_the_chain() -> None:
    visits = {}
    for balls in (100, 1000):
        velocities = np.zeros(balls)
        velocities[0] = 1.0
        solution = GeneralizedReflections().solve(chain(velocities))
        assert solution.iterations == balls - 1
        np.testing.assert_allclose(solution.v_post[-1], 1.0, atol=ROUNDING * balls)
        visits[balls] = solution.visits / balls
    assert visits[1000] <= visits[100] * 1.05


def test_a_renumbered_pack_gives_the_answer_of_its_own_order(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = sphere_pack(spheres=4000, start="kick").problem
    assert problem.m >= RENUMBERED
    renumbered = GeneralizedReflections().solve(problem)
    monkeypatch.setattr(cone_projection, "RENUMBERED", problem.m + 1)
    plain = GeneralizedReflections().solve(problem)
    assert renumbered.status is plain.status is Status.CONVERGED
    assert renumbered.iterations == plain.iterations
    np.testing.assert_allclose(renumbered.v_post, plain.v_post, atol=SAME_VELOCITY * problem.speed)
    assert renumbered.impulse is not None
    np.testing.assert_allclose(problem.v_after(renumbered.impulse), renumbered.v_post, atol=1e-12)


def test_a_body_with_too_many_contacts_is_refused_with_their_number() -> None:
    # A plate on twenty thousand balls: each contact is coupled with every other.
    balls = 20_000
    J = sp.hstack([np.ones((balls, 1)), -sp.eye_array(balls)])
    problem = ImpactProblem(np.ones(balls + 1), J, np.concatenate([[-1.0], np.zeros(balls)]))
    with pytest.raises(UnsupportedProblem, match="share bodies have up to 400020000 couplings"):
        GeneralizedReflections().solve(problem)
    with pytest.raises(UnsupportedProblem, match="couplings"):
        project(problem, np.zeros(balls), tolerance=1e-9, max_sweeps=10)


def test_an_inner_solve_that_is_cut_off_is_said() -> None:
    problem = sphere_pack(spheres=300, start="hot").problem
    solution = GeneralizedReflections(max_inner_sweeps=2).solve(problem)
    assert solution.status in (Status.STALLED, Status.ITERATION_LIMIT)
    assert np.isfinite(solution.v_post).all()
