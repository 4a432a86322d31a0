"""Rigid bodies against facts: what closed forms say of simple scenes."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidWorld
from scenarios.world.rotation import about, rotation_matrix
from scenarios.world.shapes import ball, box, hull
from solvers import Solver
from solvers.solution import Floats
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


# A top's tip slides by a part of its way in a step, and its spin acts once a step: of first order in the step, measured
# 1.2e-3 of the rate at 1e-3 s and 0.7e-3 at 0.5e-3 s.
PRECESSION = 2e-3


@pytest.mark.parametrize(("spin", "limit"), [(200.0, 0.02), (400.0, 0.005)])
def test_a_fast_top_precesses_by_its_weight_over_its_spin(spin: float, limit: float) -> None:
    ring = 2.0 * np.pi * np.arange(24) / 24
    circle = 0.1 * np.column_stack([np.cos(ring), np.sin(ring)])
    levels = [np.column_stack([circle, np.full(24, z)]) for z in (0.08, 0.11)]
    shape, tilt = hull(np.concatenate([np.zeros((1, 3)), *levels])), 0.3
    turn = about((0.0, 1.0, 0.0), tilt)
    axis, arm = rotation_matrix(turn)[:, 2], float(shape.center[2])
    across, _, along = np.sort(shape.inertia) / shape.volume
    tip = across + arm**2
    # Steady: I Ω² cos θ - I₃ ω₃ Ω + m g l = 0 about the tip, the slow root; fast: Ω = m g l / (I₃ ω₃).
    square = (along * spin) ** 2 - 4.0 * tip * np.cos(tilt) * GRAVITY * arm
    steady = (along * spin - np.sqrt(square)) / (2.0 * tip * np.cos(tilt))
    turning = spin * axis + steady * (np.array([0.0, 0.0, 1.0]) - np.cos(tilt) * axis)
    top = RigidBody("top", shape, (0.0, 0.0, 0.0), turn, np.cross(turning, arm * axis), turning, friction=5.0)
    moving = world([floor(5.0), top])
    times, angles = [], []
    for _ in range(300):
        moving.step()
        now = rotation_matrix(moving.given_pose("top")[1])[:, 2]
        times.append(moving.time)
        angles.append(np.arctan2(now[1], now[0]))
    rate = float(np.polyfit(times, np.unwrap(angles), 1)[0])
    assert rate == pytest.approx(steady, rel=PRECESSION)
    assert rate == pytest.approx(GRAVITY * arm / (along * spin), rel=limit)


def test_angular_momentum_across_an_impact_is_kept_to_first_order_in_the_step() -> None:
    errors = []
    for step in (4e-3, 1e-3):
        drift = []
        # An impact comes anywhere in its step: the mean of several.
        for late in np.linspace(0.0, 0.9, 5):
            one = RigidBody("one", CUBE, spin=(0.3, 0.2, 0.1), friction=0.3)
            start = (1.5 + 4e-3 * late, 0.4, 0.3)
            other = RigidBody("other", CUBE, start, velocity=(-5.0, 1.0, 0.0), spin=(0.0, 1.0, 2.0), friction=0.3)
            moving = world([one, other], step=step, gravity=0.0)
            before = about_the_origin(moving)
            reports = run(moving, 0.2)
            assert sum(report.contacts for report in reports) > 0
            drift.append(float(np.linalg.norm(about_the_origin(moving) - before) / np.linalg.norm(before)))
        errors.append(np.mean(drift))
    # Impulses act at the pose at which the step began: off by at most the way of a step.
    assert errors[1] < 0.5 * errors[0]
    assert errors[0] <= 5.0 * 4e-3


def about_the_origin(moving: RigidWorld) -> Floats:
    """Angular momentum of bodies of mass 1 [kg m²/s], shape (3,)."""
    total: Floats = moving.angular_momentum.sum(axis=0) + np.cross(moving.position, moving.velocity).sum(axis=0)
    return total
