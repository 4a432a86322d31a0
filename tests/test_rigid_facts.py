"""Rigid bodies against facts: what closed forms say of simple scenes."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.shapes import ball, box
from solvers import Solver
from tests.rigid_scenes import CUBE, GRAVITY, SOLVERS_WITH_FRICTION, TOLERANCE, downhill, floor, lying, run, world

every_solver = pytest.mark.parametrize("solver", SOLVERS_WITH_FRICTION.values(), ids=list(SOLVERS_WITH_FRICTION))

# Each step's velocities are solved to `TOLERANCE` of what gravity adds in it: so is their sum, relative to g t.
SOLVED = 10.0 * TOLERANCE


# Rounding of some thousand steps, each of a rotation in five parts.
ROTATIONS = 1e-12


def acceleration(friction: float, angle: float, solver: Solver) -> float:
    """Of a block that starts at rest on a slope, downhill, relative to g."""
    block = lying("block", box((0.3, 0.2, 0.1)), 0.1, angle, friction=friction)
    moving = world([floor(friction, angle=angle), block], solver)
    run(moving, 0.02)
    return float(moving.velocity[0] @ downhill(angle)) / (GRAVITY * moving.time)


@every_solver
@pytest.mark.parametrize("friction", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("steeper", [0.5, 0.9, 0.999, 1.001, 1.1, 1.5])
def test_a_block_starts_to_slide_where_the_slope_is_steeper_than_its_friction(
    steeper: float, friction: float, solver: Solver
) -> None:
    angle = np.arctan(steeper * friction)
    expected = max(np.sin(angle) - friction * np.cos(angle), 0.0)
    assert acceleration(friction, angle, solver) == pytest.approx(expected, abs=SOLVED)


@every_solver
def test_a_block_does_not_slide_on_the_slope_of_its_friction(solver: Solver) -> None:
    assert acceleration(0.5, np.arctan(0.5), solver) == pytest.approx(0.0, abs=SOLVED)


# The time of an impact follows from the speed at the end of its step: a body is stopped ½ g Δt² too high at most.
CLOSING = 0.5 * GRAVITY * 1e-6


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.8, 1.0])
def test_a_box_that_falls_flat_keeps_the_square_of_its_restitution_of_its_energy(restitution: float) -> None:
    height = 0.5
    falling = RigidBody("box", CUBE, (0.0, 0.0, 0.5 + height), restitution=restitution)
    moving = world([floor(restitution=restitution), falling])
    run(moving, np.sqrt(2.0 * height / GRAVITY) - 2e-3)
    while moving.step().contacts == 0:
        pass
    left = moving.kinetic_energy() + moving.potential_energy() - 0.5 * GRAVITY
    assert left == pytest.approx(restitution**2 * height * GRAVITY, abs=2.0 * GRAVITY * CLOSING)


def test_a_bouncing_box_keeps_its_energy_at_restitution_one() -> None:
    moving = world([floor(restitution=1.0), RigidBody("box", CUBE, (0.0, 0.0, 0.75), restitution=1.0)], step=2e-3)
    start = moving.kinetic_energy() + moving.potential_energy()
    reports = run(moving, 0.75)
    bounces = sum(report.contacts > 0 for report in reports)
    assert bounces >= 2
    assert moving.kinetic_energy() + moving.potential_energy() == pytest.approx(start, rel=bounces * SOLVED)


@every_solver
@pytest.mark.parametrize("angle", [0.1, 0.3, 0.6])
def test_a_ball_rolls_down_a_slope_with_five_sevenths_of_the_acceleration_of_one_that_slides(
    angle: float, solver: Solver
) -> None:
    moving = world([floor(1.0, angle=angle), lying("ball", ball(0.2), 0.2, angle, friction=1.0)], solver)
    run(moving, 0.04)
    speed = float(moving.velocity[0] @ downhill(angle))
    assert speed == pytest.approx(5.0 / 7.0 * GRAVITY * np.sin(angle) * moving.time, rel=SOLVED)
    assert moving.spin[0] == pytest.approx([0.0, speed / 0.2, 0.0], abs=SOLVED * speed / 0.2)


@every_solver
def test_a_ball_that_slides_ends_up_rolling_with_five_sevenths_of_its_speed(solver: Solver) -> None:
    moving = world([floor(0.3), lying("ball", ball(0.2), 0.2, friction=0.3, speed=1.0)], solver)
    # It slides until 2 v / (7 μ g) = 0.097 s.
    run(moving, 0.09)
    assert moving.velocity[0, 0] == pytest.approx(1.0 - 0.3 * GRAVITY * moving.time, rel=SOLVED)
    run(moving, 0.06)
    assert moving.velocity[0] == pytest.approx([5.0 / 7.0, 0.0, 0.0], abs=SOLVED)


def test_a_ball_on_a_smooth_slope_slides_without_rolling() -> None:
    moving = world([floor(0.0, angle=0.3), lying("ball", ball(0.2), 0.2, 0.3)])
    run(moving, 0.04)
    assert moving.velocity[0] @ downhill(0.3) == pytest.approx(GRAVITY * np.sin(0.3) * moving.time, rel=SOLVED)
    assert np.abs(moving.spin).max() <= ROTATIONS


def test_a_free_top_keeps_its_angular_momentum_and_its_energy_to_second_order() -> None:
    energy_errors = []
    for step in (4e-3, 2e-3):
        # About the middle axis: it tumbles over again and again.
        top = RigidBody("top", box((0.1, 0.3, 0.5)), spin=(0.1, 20.0, 0.2), mass=2.0)
        moving = world([top], step=step, gravity=0.0)
        momentum, energy = moving.angular_momentum[0].copy(), moving.kinetic_energy()
        worst = 0.0
        for _ in range(round(0.8 / step)):
            moving.step()
            worst = max(worst, abs(moving.kinetic_energy() / energy - 1.0))
        assert moving.angular_momentum[0] == pytest.approx(momentum, abs=ROTATIONS * float(np.linalg.norm(momentum)))
        energy_errors.append(worst)
    # A quarter of the error at half the step.
    assert energy_errors[0] / energy_errors[1] == pytest.approx(4.0, rel=0.1)
    assert energy_errors[1] < 1e-3


def test_a_body_in_free_flight_follows_its_parabola_exactly() -> None:
    thrown = RigidBody("box", box((0.1, 0.2, 0.3)), velocity=(1.0, 2.0, 3.0), spin=(1.0, 2.0, 3.0))
    moving = world([thrown])
    reports = run(moving, 0.2)
    assert moving.position[0] == pytest.approx([0.2, 0.4, 0.6 - 0.02 * GRAVITY], abs=ROTATIONS)
    assert moving.angular_momentum[0] == pytest.approx(
        world([thrown]).angular_momentum[0], abs=ROTATIONS * float(np.linalg.norm(moving.angular_momentum[0]))
    )
    scale = moving.kinetic_energy()
    assert abs(sum(report.energy.integration for report in reports)) <= 1e-6 * scale
