"""A row of falling dominos against the theory of a row that leans, and against MuJoCo's own dynamics.

Every domino turns about its front bottom edge, without slip; behind the head of the train each leans on the next one:

    h sin(θ_j - θ) = p cos θ - d                           θ: of the next one; h, d, p: height, thickness, pitch
    I θ̈_j = ½ m g (h sin θ_j - d cos θ_j) + b_j F_j₋₁ - a_j F_j
    a_j = h cos(θ_j - θ) + μ h sin(θ_j - θ),   b_j = h cos(θ_j₋₁ - θ_j) - p sin θ_j - μ d

F_j is what domino j presses on the next one with, sliding down along its back with friction μ. With weights p_j that
cancel all F (p = 1 at the head, p_j a_j = p_j₊₁ b_j₊₁), one equation is left, for the head. The head meets the next
domino at sin θ = (p - d)/h; all spins change at once, by impulses in the place of F, and the train is longer by one.

Source: van Leeuwen 2010, "The domino effect"; what pushes on stays in touch: Shaw 1978.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.shapes import box
from solvers.qce_lcp import QceLcp
from solvers.solution import Floats
from tests.rigid_scenes import GRAVITY, floor, world

# Half thickness, width and height of a domino, and the pitch of the row [m].
DOMINO = (0.004, 0.0125, 0.025)
PITCH = 0.02
DOMINOS = 14
# Tilt at which a domino counts as falling, and the spin that the first one gets [rad, rad/s].
FALLING, PUSH = 0.1, 6.0
FRICTION = 0.2
# An impact acts at the start of its step, a tilt is seen at the end of one, and gaps below a hair's breadth are closed:
# every domino may be late by so many steps of a millisecond (measured: 3.6 at most).
LATE = 5.0
# Between the fifth domino and the last but one these errors are nearly the same (measured: 0.5 % at most).
SPEED = 0.01


def leaning(head: float, count: int, friction: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Angles θ of a train [rad], dθ/dθ_head, d²θ/dθ_head² and weights p, head first; shape (count,) each."""
    thickness, height = 2.0 * DOMINO[0], 2.0 * DOMINO[2]
    train = np.zeros((4, count))
    train[:, 0] = head, 1.0, 0.0, 1.0
    for j in range(1, count):
        angle, slope, bend, weight = train[:, j - 1]
        sine = (PITCH * np.cos(angle) - thickness) / height
        cosine = np.sqrt(1.0 - sine**2)
        first, second = -PITCH * np.sin(angle) / height, -PITCH * np.cos(angle) / height
        slope_here = 1.0 + first / cosine
        bend_here = second / cosine + sine * first**2 / cosine**3
        pushed = height * (cosine + first) - friction * thickness
        pushing = height * (cosine + friction * sine)
        train[:, j] = (
            angle + np.arcsin(sine), slope_here * slope, bend_here * slope**2 + slope_here * bend,
            weight * pushed / pushing,
        )  # fmt: skip
    return train[0], train[1], train[2], train[3]


def times_by_theory(friction: float) -> Floats:
    """When each domino of a row is tilted by `FALLING` [s]."""
    thickness, height = 2.0 * DOMINO[0], 2.0 * DOMINO[2]
    inertia = (height**2 + thickness**2) / 3.0
    meeting = np.arcsin((PITCH - thickness) / height)
    spin, start, times = PUSH, 0.0, []

    def turning(count: int) -> Callable[[float, Floats], Floats]:
        def rate(_: float, state: Floats) -> Floats:
            angle, slope, bend, weight = leaning(state[0], count, friction)
            torque = 0.5 * GRAVITY * (height * np.sin(angle) - thickness * np.cos(angle))
            force = weight @ (torque - inertia * bend * state[1] ** 2)
            return np.array([state[1], force / (inertia * (weight @ slope))])

        return rate

    def reaches(angle: float) -> Callable[[float, Floats], float]:
        return lambda _, state: float(state[0]) - angle

    for count in range(1, DOMINOS + 1):
        events = [reaches(FALLING), reaches(meeting)]
        flight = solve_ivp(turning(count), (0.0, 1.0), [0.0, spin], method="DOP853", rtol=1e-6, events=events)
        times.append(start + flight.t_events[0][0])
        start += flight.t_events[1][0]
        _, slope, _, weight = leaning(0.0, count + 1, friction)
        spin = flight.y_events[1][0][1] * (weight[1:] @ slope[1:]) / (weight @ slope)
    return np.array(times)


def times_here(friction: float, *, ground: float, step: float) -> Floats:
    """The same in a scene, with the friction of its ground; of the last one it is not waited for: NaN."""
    row = [
        RigidBody(
            f"domino {k}", box(DOMINO), (k * PITCH, 0.0, DOMINO[2]), friction=friction, density=1000.0,
            spin=(0.0, PUSH * (k == 0), 0.0), velocity=(PUSH * DOMINO[2] * (k == 0), 0.0, PUSH * DOMINO[0] * (k == 0)),
        )
        for k in range(DOMINOS)
    ]  # fmt: skip
    moving = world([floor(ground), *row], QceLcp(tolerance=1e-6, max_sweeps=500), step=step)
    times = np.full(DOMINOS, np.nan)
    while np.isnan(times[-2]) and moving.time < 1.5:
        moving.step()
        # 2 arcsin of the quaternion's y: they turn about y alone.
        tilt = 2.0 * np.arcsin(np.clip(moving.orientation[:, 2], -1.0, 1.0))
        times[np.isnan(times) & (tilt > FALLING)] = moving.time
    return times


def times_by_mujoco() -> Floats:
    """The same by MuJoCo's dynamics: stiff contacts without restitution, a twentieth of the step."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 2.5e-5, [0.0, 0.0, -GRAVITY]
    spec.option.cone, spec.option.integrator = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtIntegrator.mjINT_EULER
    contact: dict[str, Any] = {"friction": [FRICTION, 0.0, 0.0], "solref": [1e-3, 1.0], "condim": 3}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], **contact)
    for k in range(DOMINOS):
        body = spec.worldbody.add_body(pos=[k * PITCH, 0.0, DOMINO[2]])
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=DOMINO, density=1000.0, **contact)
    model = spec.compile()
    state = mujoco.MjData(model)
    state.qvel[0], state.qvel[2], state.qvel[4] = PUSH * DOMINO[2], PUSH * DOMINO[0], PUSH
    times = np.full(DOMINOS, np.nan)
    while np.isnan(times[-2]) and state.time < 1.5:
        mujoco.mj_step(model, state)
        tilt = 2.0 * np.arcsin(np.clip(state.qpos.reshape(-1, 7)[:, 5], -1.0, 1.0))
        times[np.isnan(times) & (tilt > FALLING)] = state.time
    return times


def wave_speed(times: Floats) -> float:
    """Of the front between the fifth and the last domino but one [m/s]."""
    return float(PITCH * (DOMINOS - 6) / (times[-2] - times[4]))


def rough(friction: float) -> float:
    """Friction of a ground on which dominos do not slip: √(μ ground) = 1."""
    return 1.0 / friction


@pytest.mark.parametrize("friction", [1e-3, FRICTION])
def test_each_domino_falls_when_the_theory_of_a_row_that_leans_says(friction: float) -> None:
    step = 1e-3
    here, theory = times_here(friction, ground=rough(friction), step=step), times_by_theory(friction)
    late = (here - theory)[:-1] / step
    assert (late >= 0.0).all()
    assert (late <= LATE).all()
    assert wave_speed(here) == pytest.approx(wave_speed(theory), rel=SPEED)


@pytest.mark.long
@pytest.mark.parametrize("friction", [1e-3, 0.1, 0.2, 0.4])
def test_the_wave_is_as_fast_as_in_the_theory(friction: float, capsys: pytest.CaptureFixture[str]) -> None:
    step = 2.5e-4
    here, theory = times_here(friction, ground=rough(friction), step=step), times_by_theory(friction)
    late = (here - theory)[:-1].max()
    with capsys.disabled():
        print(f"\nμ = {friction:g}: {wave_speed(here):.4f} m/s here, {wave_speed(theory):.4f} by theory, ", end="")
        print(f"late by {1e3 * late:.2f} ms at most in {theory[-2]:.3f} s")
    assert late <= LATE * 1e-3
    assert wave_speed(here) == pytest.approx(wave_speed(theory), rel=SPEED)


@pytest.mark.long
def test_a_row_of_dominos_falls_as_fast_as_in_an_independent_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    here, there = wave_speed(times_here(FRICTION, ground=FRICTION, step=5e-4)), wave_speed(times_by_mujoco())
    with capsys.disabled():
        print(f"\nwave of dominos that slip: {here:.3f} m/s here, {there:.3f} m/s by MuJoCo, ", end="")
        print(f"{wave_speed(times_by_theory(FRICTION)):.3f} m/s by the theory, in which none slips")
    # MuJoCo's contacts are springs: they give way, and take time.
    assert here == pytest.approx(there, rel=0.05)
