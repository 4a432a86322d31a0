"""Recovery of jammed problems: what it ends with, what it cannot do, and that it is off unless asked for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios import CATALOG
from scenarios.scenario import Scenario
from solvers import ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem
from solvers.generalized_reflections import GeneralizedReflections
from solvers.newton_lcp import NewtonLcp
from solvers.pairwise import GaussSeidel
from solvers.quadratic_contact_energy import QuadraticContactEnergy
from solvers.recovery import TOLERANCE, resolve
from tests.random_problems import problems

# Rounding of an energy that is a sum of up to a hundred squares, relative to it.
ENERGY_ROUNDING = 1e-13
# The inelastic LCP stops at this natural map; the velocity is then computed anew from the impulses.
APPROACH = 10 * TOLERANCE

JAMMED = {
    "one ball between walls": CATALOG["ball-between-walls"](balls=1),
    "ten balls between walls": CATALOG["ball-between-walls"](balls=10),
    "ring, one moves": CATALOG["ball-ring"](),
    "ring, all move": CATALOG["ball-ring"](start="all"),
    "box": CATALOG["jammed-box"](rows=4, columns=5),
    "ring, half elastic": CATALOG["ball-ring"](balls=12, restitution=0.5),
}
LAWS: dict[str, Solver] = {
    "qce": QuadraticContactEnergy(max_iterations=25),
    "gr": GeneralizedReflections(max_iterations=25),
    "gauss-seidel": GaussSeidel(max_iterations=25),
}
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
every_jammed_scene = pytest.mark.parametrize("scene", JAMMED.values(), ids=JAMMED)


def answered(law: Solver, problem: ImpactProblem) -> ImpactSolution:
    try:
        return law.solve(problem)
    except UnsupportedProblem as refusal:
        pytest.skip(str(refusal))


def approach(problem: ImpactProblem, solution: ImpactSolution) -> float:
    return max(0.0, -float((problem.J @ solution.v_post).min(initial=0.0))) / problem.speed


@every_law
@every_jammed_scene
def test_a_recovered_jammed_scene_has_no_approach_no_pull_and_no_energy_gained(law: Solver, scene: Scenario) -> None:
    problem = scene.problem
    before = answered(law, problem)
    after = resolve(problem, before)
    assert after.impulse is not None
    assert before.impulse is not None
    if before.status is Status.CONVERGED:
        assert after is before
        return
    assert approach(problem, before) > 1e-6, "the scene would not need a recovery"
    assert approach(problem, after) <= APPROACH
    assert after.residual <= APPROACH
    assert (after.impulse >= before.impulse).all()
    assert problem.kinetic_energy(after.v_post) <= problem.kinetic_energy(before.v_post) * (1 + ENERGY_ROUNDING)
    np.testing.assert_allclose(problem.v_after(after.impulse), after.v_post, atol=1e-12)


@every_jammed_scene
def test_recovery_takes_bounded_work(scene: Scenario) -> None:
    problem = scene.problem
    before = answered(LAWS["qce"], problem) if (problem.restitution == 1).all() else LAWS["gr"].solve(problem)
    after = resolve(problem, before, max_sweeps=50)
    # A sweep visits a contact at most twice, and the residual is measured once more after each few.
    assert after.visits - before.visits <= 4 * (50 + 10) * problem.m
    assert after.iterations <= before.iterations + 1


@settings(max_examples=60, deadline=None)
@given(problem=problems, iterations=st.integers(min_value=0, max_value=3))
def test_no_iterate_of_any_law_gains_energy_or_loses_momentum_by_recovery(
    problem: ImpactProblem, iterations: int
) -> None:
    for law in (
        QuadraticContactEnergy(max_iterations=iterations),
        GeneralizedReflections(max_iterations=iterations),
        NewtonLcp(max_iterations=max(iterations, 1)),
    ):
        before = law.solve(problem)
        after = resolve(problem, before)
        if before.status is Status.CONVERGED:
            continue
        scale = max(problem.kinetic_energy(before.v_post), problem.kinetic_energy(problem.v_pre))
        gained = problem.kinetic_energy(after.v_post) - problem.kinetic_energy(before.v_post)
        assert gained <= ENERGY_ROUNDING * scale
        assert approach(problem, after) <= APPROACH
        # An impulse of the same contacts keeps every momentum c with J c = 0: the change lies in the range of M⁻¹Jᵀ.
        assert before.impulse is not None
        assert after.impulse is not None
        change = problem.v_after(after.impulse) - problem.v_after(before.impulse)
        np.testing.assert_allclose(after.v_post - before.v_post, change, atol=1e-9 * problem.speed)


@settings(max_examples=40, deadline=None)
@given(problem=problems, sweeps=st.integers(min_value=1, max_value=8))
def test_an_inelastic_lcp_that_is_cut_off_cannot_raise_the_energy_either(problem: ImpactProblem, sweeps: int) -> None:
    before = QuadraticContactEnergy(max_iterations=0).solve(problem)
    after = resolve(problem, before, max_sweeps=sweeps)
    energy = problem.kinetic_energy(before.v_post)
    assert problem.kinetic_energy(after.v_post) <= energy * (1 + ENERGY_ROUNDING)
    assert after.impulse is not None
    assert after.impulse.min(initial=0.0) >= 0.0


def test_the_status_still_says_that_the_law_did_not_end() -> None:
    problem = JAMMED["ring, all move"].problem
    before = LAWS["qce"].solve(problem)
    assert before.status is Status.ITERATION_LIMIT
    assert resolve(problem, before).status is before.status


def test_a_converged_answer_is_returned_as_it_is() -> None:
    problem = CATALOG["newtons-cradle"]().problem
    solution = QuadraticContactEnergy().solve(problem)
    assert resolve(problem, solution) is solution
    assert QuadraticContactEnergy(recover_after=100).solve(problem).v_post.tobytes() == solution.v_post.tobytes()


@pytest.mark.parametrize("status", [Status.NOT_FINITE, Status.UNSUPPORTED])
def test_an_answer_that_cannot_be_recovered_is_returned_as_it_is(status: Status) -> None:
    problem = CATALOG["newtons-cradle"]().problem
    solution = ImpactSolution(np.zeros(problem.m), problem.v_pre.copy(), status, 1, 1)
    assert resolve(problem, solution) is solution


def test_a_velocity_that_is_not_finite_is_returned_as_it_is() -> None:
    problem = CATALOG["newtons-cradle"]().problem
    solution = ImpactSolution(np.zeros(problem.m), np.full(problem.n, np.nan), Status.STALLED, 1, 1)
    assert resolve(problem, solution) is solution


def test_an_engine_that_knows_no_impulse_is_recovered_in_its_velocity_alone() -> None:
    problem = JAMMED["ten balls between walls"].problem
    before = ImpactSolution(None, problem.v_pre.copy(), Status.STALLED, 3, 0)
    after = resolve(problem, before)
    assert after.impulse is None
    assert approach(problem, after) <= APPROACH
    assert problem.kinetic_energy(after.v_post) <= problem.kinetic_energy(problem.v_pre)


def test_friction_impulses_are_kept_and_stay_within_their_bounds() -> None:
    problem = CATALOG["box-on-floor"](points=9, slide=1.0, restitution=0.5, friction=0.3).problem
    before = NewtonLcp(max_iterations=1).solve(problem)
    assert before.status is Status.ITERATION_LIMIT
    after = resolve(problem, before)
    assert before.friction_impulse is not None
    assert after.friction_impulse is not None
    assert after.impulse is not None
    assert after.friction_impulse.tobytes() == before.friction_impulse.tobytes()
    assert (np.abs(after.friction_impulse) <= np.repeat(problem.friction * after.impulse, 2) * (1 + 1e-12)).all()
    assert approach(problem, after) <= APPROACH
    assert problem.kinetic_energy(after.v_post) <= problem.kinetic_energy(before.v_post) * (1 + ENERGY_ROUNDING)


def test_without_elastic_iterations_recovery_is_the_inelastic_impact() -> None:
    problem = CATALOG["sphere-pack"](spheres=100).problem
    recovered = resolve(problem, QuadraticContactEnergy(max_iterations=0).solve(problem))
    inelastic = NewtonLcp().solve(problem.replace(restitution=0.0))
    # Velocities of the inelastic LCP are unique; both solves stop at a residual of 1e-11 or below.
    np.testing.assert_allclose(recovered.v_post, inelastic.v_post, atol=1e-8)


def test_a_recovered_law_refuses_as_the_law_does() -> None:
    law = QuadraticContactEnergy(recover_after=100)
    with pytest.raises(UnsupportedProblem, match="restitution must be 1"):
        law.solve(CATALOG["newtons-cradle"](restitution=0.5).problem)


def test_recovery_is_off_unless_it_is_asked_for() -> None:
    problem = JAMMED["one ball between walls"].problem
    plain = QuadraticContactEnergy(max_iterations=25).solve(problem)
    assert plain.status is Status.ITERATION_LIMIT
    assert approach(problem, plain) == pytest.approx(1.0)
    # Elastic: the ball goes to and fro and keeps its energy; recovered, it stops.
    recovered = QuadraticContactEnergy(recover_after=25).solve(problem)
    assert recovered.v_post == pytest.approx([0.0], abs=1e-12)


@every_jammed_scene
@pytest.mark.parametrize("law", [QuadraticContactEnergy, GeneralizedReflections])
def test_recovery_is_a_setting_that_ends_jammed_scenes_and_is_off_by_default(
    law: type[QuadraticContactEnergy] | type[GeneralizedReflections], scene: Scenario
) -> None:
    problem = scene.problem
    assert law().recover_after == 0
    try:
        plain = law(max_iterations=25).solve(problem)
        recovered = law(recover_after=25).solve(problem)
    except UnsupportedProblem:
        return
    assert plain.status is not Status.CONVERGED
    assert (problem.J @ plain.v_post).min() < -APPROACH * problem.speed
    # The law did not end, and says so; what approached no longer does, at no gain of energy.
    assert recovered.status is plain.status
    assert (problem.J @ recovered.v_post).min() >= -APPROACH * problem.speed
    assert problem.kinetic_energy(recovered.v_post) <= problem.kinetic_energy(plain.v_post) * (1 + ENERGY_ROUNDING)
