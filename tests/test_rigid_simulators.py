"""Rigid bodies against MuJoCo's own dynamics, stacks that stand, and a wave of falling dominos."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.shapes import box
from solvers.qce_lcp import QceLcp
from tests.rigid_scenes import CUBE, GRAVITY, floor, run, world

# Half thickness, width and height of a domino, and the pitch of the row [m].
DOMINO = (0.004, 0.0125, 0.025)
PITCH = 0.02
DOMINOS = 14
# Tilt at which a domino counts as falling, and the spin that the first one gets [rad, rad/s].
FALLING, PUSH = 0.1, 6.0
FRICTION = 0.2


def wave_times_here() -> list[float]:
    """When each domino of a row begins to fall [s]."""
    row = [
        RigidBody(
            f"domino {k}", box(DOMINO), (k * PITCH, 0.0, DOMINO[2]), friction=FRICTION, density=1000.0,
            spin=(0.0, PUSH * (k == 0), 0.0), velocity=(PUSH * DOMINO[2] * (k == 0), 0.0, 0.0),
        )
        for k in range(DOMINOS)
    ]  # fmt: skip
    moving = world([floor(FRICTION), *row], QceLcp(tolerance=1e-6, max_sweeps=500), step=5e-4)
    times = np.full(DOMINOS, np.nan)
    while np.isnan(times[-1]) and moving.time < 1.5:
        moving.step()
        # 2 arcsin of the quaternion's y: they turn about y alone.
        tilt = 2.0 * np.arcsin(np.clip(moving.orientation[:, 2], -1.0, 1.0))
        times[np.isnan(times) & (tilt > FALLING)] = moving.time
    return [float(time) for time in times]


def wave_times_by_mujoco() -> list[float]:
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
    state.qvel[0], state.qvel[4] = PUSH * DOMINO[2], PUSH
    times = np.full(DOMINOS, np.nan)
    while np.isnan(times[-1]) and state.time < 1.5:
        mujoco.mj_step(model, state)
        tilt = 2.0 * np.arcsin(np.clip(state.qpos.reshape(-1, 7)[:, 5], -1.0, 1.0))
        times[np.isnan(times) & (tilt > FALLING)] = state.time
    return [float(time) for time in times]


def wave_speed(times: list[float]) -> float:
    """Of the front between the fifth and the last domino but one [m/s]: it runs steadily there."""
    return PITCH * (DOMINOS - 6) / (times[-2] - times[4])


@pytest.mark.long
def test_a_row_of_dominos_falls_as_fast_as_in_an_independent_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    here, there = wave_speed(wave_times_here()), wave_speed(wave_times_by_mujoco())
    with capsys.disabled():
        scaled = here / np.sqrt(GRAVITY * 2.0 * DOMINO[2])
        print(f"\nwave of dominos: {here:.3f} m/s here, {there:.3f} m/s by MuJoCo, {scaled:.2f} √(g h)")
    # MuJoCo's contacts are springs: they give way, and take time.
    assert here == pytest.approx(there, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("count", [10, 50])
def test_a_stack_stands(count: int) -> None:
    boxes = [RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(count)]
    moving = world([floor(), *boxes], QceLcp(tolerance=1e-6, max_sweeps=500))
    start = moving.position.copy()
    reports = run(moving, 2.0)
    # A millionth of a box's side.
    assert np.abs(moving.position - start).max() <= 1e-6
    assert max(report.residual for report in reports) <= 1e-6
    assert moving.kinetic_energy() <= 1e-12


def test_a_sliding_box_stops_where_an_independent_simulator_and_coulomb_say() -> None:
    speed, friction = 1.0, 0.4
    sliding = RigidBody("box", box((0.3, 0.2, 0.1)), (0.0, 0.0, 0.1), velocity=(speed, 0.0, 0.0), friction=friction)
    moving = world([floor(friction), sliding], QceLcp(tolerance=1e-6))
    run(moving, 1.2 * speed / (friction * GRAVITY))
    expected = speed**2 / (2.0 * friction * GRAVITY)
    # Half of a step's way at the start's speed: velocities change at the start of a step.
    assert moving.position[0, 0] == pytest.approx(expected, abs=0.5 * speed * 1e-3 * 1.01)
    assert np.abs(moving.velocity).max() <= 1e-6

    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 1e-4, [0.0, 0.0, -GRAVITY]
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 100.0
    contact: dict[str, Any] = {"friction": [friction, 0.0, 0.0], "condim": 3}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], **contact)
    body = spec.worldbody.add_body(pos=[0.0, 0.0, 0.1])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.3, 0.2, 0.1], density=1.0, **contact)
    model = spec.compile()
    state = mujoco.MjData(model)
    state.qvel[0] = speed
    while state.time < moving.time:
        mujoco.mj_step(model, state)
    # Its soft contacts let the box sink in at first, and slide on a little.
    assert moving.position[0, 0] == pytest.approx(state.qpos[0], rel=0.02)
