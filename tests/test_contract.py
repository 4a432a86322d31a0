"""The contract: every solver × every scenario of the default tier."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from scenarios import CATALOG
from scenarios.scenario import Scenario
from scenarios.tiers import TIERS
from solvers import SOLVERS, ImpactSolution, Status, UnsupportedProblem

INSTANCES = TIERS["default"]
every_solver = pytest.mark.parametrize("name", sorted(SOLVERS))
every_scenario = pytest.mark.parametrize(
    "instance", range(len(INSTANCES)), ids=[f"{family}-{parameters}" for family, parameters in INSTANCES]
)

# v_post and v_after(impulse) are the same sum in another order, over up to 3,000 contacts; Jacobi's impulses grow
# beyond the velocities that remain of them.
SUM = 1e-10
# ONE of the harness.
VIOLATION = 1e-9


@cache
def scenario(instance: int) -> Scenario:
    family, parameters = INSTANCES[instance]
    return CATALOG[family](**parameters)


@cache
def solved(name: str, instance: int) -> ImpactSolution | str:
    """The solution, or the reason of a refusal; each pair is solved once for all tests."""
    try:
        return SOLVERS[name]().solve(scenario(instance).problem)
    except UnsupportedProblem as refusal:
        return str(refusal)


def answer(name: str, instance: int) -> ImpactSolution:
    solution = solved(name, instance)
    if isinstance(solution, str):
        pytest.skip(solution)
    return solution


@every_solver
@every_scenario
def test_the_answer_has_the_shapes_and_is_finite(name: str, instance: int) -> None:
    problem, solution = scenario(instance).problem, answer(name, instance)
    assert solution.impulse is not None
    assert solution.impulse.shape == (problem.m,)
    assert solution.v_post.shape == (problem.n,)
    assert np.isfinite(solution.impulse).all()
    assert np.isfinite(solution.v_post).all()
    assert isinstance(solution.status, Status)
    assert solution.iterations >= 0
    assert solution.visits >= 0


@every_solver
@every_scenario
def test_the_velocity_is_what_the_impulses_give(name: str, instance: int) -> None:
    problem, solution = scenario(instance).problem, answer(name, instance)
    assert solution.impulse is not None
    scale = problem.speed + float((problem.W_diagonal * solution.impulse).max(initial=0.0))
    v_post = problem.v_after(solution.impulse, solution.friction_impulse)
    np.testing.assert_allclose(v_post, solution.v_post, atol=SUM * scale)


@every_solver
@every_scenario
def test_no_impulse_pulls(name: str, instance: int) -> None:
    solution = answer(name, instance)
    assert solution.impulse is not None
    assert solution.impulse.min(initial=0.0) >= 0.0


@every_solver
@every_scenario
def test_no_contact_approaches_after_a_converged_impact(name: str, instance: int) -> None:
    problem, solution = scenario(instance).problem, answer(name, instance)
    if solution.status is not Status.CONVERGED:
        pytest.skip(f"{solution.status}: it says so itself")
    # Newton's restitution lets a contact that separated before approach afterwards, at most as fast (the scorecard
    # shows it under ONE); friction moves normal velocities after the laws that solve it last.
    allowed = np.full(problem.m, VIOLATION * problem.speed)
    if name.startswith("lcp"):
        allowed += problem.restitution * np.maximum(problem.u_pre, 0.0)
    if problem.has_friction and name in ("gr", "qce-blend"):
        pytest.skip("friction is solved with the normal impulses held")
    assert (problem.J @ solution.v_post >= -allowed).all()


@every_solver
@every_scenario
def test_friction_stays_within_its_bound(name: str, instance: int) -> None:
    problem, solution = scenario(instance).problem, answer(name, instance)
    if not problem.has_friction:
        assert solution.friction_impulse is None or not solution.friction_impulse.any()
        return
    assert solution.impulse is not None
    assert solution.friction_impulse is not None
    bound = np.repeat(problem.friction * solution.impulse, 2)
    assert (np.abs(solution.friction_impulse) <= bound * (1 + 1e-12)).all()


@every_solver
@every_scenario
def test_the_same_problem_gives_the_same_bits(name: str, instance: int) -> None:
    solution = answer(name, instance)
    if solution.visits > 10_000_000:
        pytest.skip("a second solve of a jammed scene tells nothing new")
    again = SOLVERS[name]().solve(scenario(instance).problem)
    assert again.v_post.tobytes() == solution.v_post.tobytes()
