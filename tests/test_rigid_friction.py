"""Impacts with friction on which sweeps creep: redundant contacts that slide and turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.metamorphic import random_renumbering, renumbered
from scenarios.world.rigid_bodies import FREEDOMS, RigidBody
from scenarios.world.shapes import box
from solvers import ImpactProblem, Status
from solvers.proximal_newton import ITERATIONS, eliminate, proximal_step
from solvers.qce_lcp import QceLcp
from solvers.solution import Floats
from tests.rigid_scenes import floor, run, world

TOLERANCE = 1e-9
# Rounding of the proximal step's test, of a few hundred rows, beside the solver's own.
MEASURED = 1e-11
# Other orders of elimination round otherwise; a solution that depended on the order would differ by 1e-3.
RENUMBERED = 1e-9
FLAT = box((0.5, 0.4, 0.1))


def pile(seed: int, bodies: int) -> ImpactProblem:
    """The impact of flat boxes that lie on one another, each sliding and turning its own way."""
    random = np.random.default_rng(seed)
    boxes = [
        RigidBody(
            f"box {k}", FLAT, (*random.uniform(-0.1, 0.1, 2), 0.1 + 0.2 * k),
            velocity=(*random.normal(size=2), 0.0), spin=(0.0, 0.0, random.normal()), friction=random.uniform(0.2, 0.9),
        )
        for k in range(bodies)
    ]  # fmt: skip
    return world([floor(0.8), *boxes]).problem()


def violation(problem: ImpactProblem, impulse: Floats, friction_impulse: Floats) -> float:
    """Natural map of the boxed LCP with target 0, from dense matrices, relative to the fastest approach."""
    assert problem.D is not None
    inverse_mass, J, D = problem.inverse_mass.toarray(), problem.J.toarray(), problem.D.toarray()
    v = problem.v_pre + inverse_mass @ (J.T @ impulse + D.T @ friction_impulse)
    normal = np.abs(np.minimum(J @ v, np.diag(J @ inverse_mass @ J.T) * impulse))
    weight = np.diag(D @ inverse_mass @ D.T)
    bound = np.repeat(problem.friction * impulse, 2)
    tangent = np.abs(np.clip(friction_impulse - D @ v / weight, -bound, bound) - friction_impulse) * weight
    return float(max(normal.max(), tangent.max())) / problem.speed


@given(seed=st.integers(0, 10_000), bodies=st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_boxes_that_slide_and_turn_on_one_another_are_solved_to_the_tolerance(seed: int, bodies: int) -> None:
    problem = pile(seed, bodies)
    solution = QceLcp(tolerance=TOLERANCE, max_sweeps=1000).solve(problem)
    assert solution.status is Status.CONVERGED
    assert solution.impulse is not None
    assert solution.friction_impulse is not None
    assert violation(problem, solution.impulse, solution.friction_impulse) <= TOLERANCE + MEASURED
    assert problem.kinetic_energy(solution.v_post) <= problem.kinetic_energy(problem.v_pre) * (1.0 + MEASURED)


@given(seed=st.integers(0, 10_000), bodies=st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_boxes_that_slide_and_turn_move_alike_however_their_contacts_are_numbered(seed: int, bodies: int) -> None:
    # The corners of a face share its load in many ways, each with a friction of its own: other velocities solve it too.
    problem = pile(seed, bodies)
    contacts, velocities = random_renumbering(
        np.random.default_rng(seed), m=problem.m, n=problem.n, dofs_per_body=FREEDOMS
    )
    law = QceLcp(tolerance=1e-6, max_sweeps=1000)
    other = law.solve(renumbered(problem, contacts, velocities)).v_post
    difference = np.linalg.norm(other - law.solve(problem).v_post[velocities])
    assert difference <= RENUMBERED * np.linalg.norm(problem.v_pre)


def test_a_proximal_step_from_a_solution_stays_there() -> None:
    problem = pile(1, 3)
    solution = QceLcp(tolerance=TOLERANCE, max_sweeps=1000).solve(problem)
    assert solution.impulse is not None
    assert solution.friction_impulse is not None
    elimination = eliminate(problem)
    assert elimination is not None
    impulse, friction_impulse, solved, iterations = proximal_step(
        problem, elimination, np.zeros(problem.m), solution.impulse, solution.friction_impulse,
        epsilon=1e-2, tolerance=10.0 * TOLERANCE * problem.speed,
    )  # fmt: skip
    assert solved
    assert iterations <= 2
    assert violation(problem, impulse, friction_impulse) <= 10.0 * TOLERANCE


def test_the_bound_on_sweeps_holds_and_what_ends_early_gains_no_energy() -> None:
    for seed in range(10):
        problem = pile(seed, 6)
        for bound in (1, ITERATIONS, ITERATIONS + 1, 60):
            solution = QceLcp(tolerance=1e-15, max_sweeps=bound).solve(problem)
            assert solution.iterations <= bound
            assert problem.kinetic_energy(solution.v_post) <= problem.kinetic_energy(problem.v_pre) * (1.0 + MEASURED)


@pytest.mark.long
def test_a_pile_in_motion_is_solved_in_nearly_all_of_its_steps(capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(0)
    boxes = [
        RigidBody(f"box {k}", FLAT, (0.3 * (k % 3), 0.3 * (k % 2), 0.6 + 1.2 * k), random.normal(size=4))
        for k in range(12)
    ]
    moving = world([floor(), *boxes], QceLcp(tolerance=1e-6, max_sweeps=1000))
    reports = run(moving, 3.0)
    unsolved = sum(report.status is not Status.CONVERGED for report in reports)
    with capsys.disabled():
        iterations = [report.iterations for report in reports]
        print(f"\n{unsolved} of {len(reports)} steps not converged; {np.mean(iterations):.0f} iterations in the mean")
    assert unsolved <= 0.01 * len(reports)
