"""Rigid bodies against MuJoCo's own dynamics, and stacks that stand."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.shapes import box
from solvers.qce_lcp import QceLcp
from tests.rigid_scenes import CUBE, GRAVITY, floor, run, world


@pytest.mark.long
@pytest.mark.parametrize("count", [10, 50])
def test_a_stack_stands(count: int) -> None:
    boxes = [RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(count)]
    moving = world([floor(), *boxes], QceLcp(tolerance=1e-8, max_sweeps=500))
    start = moving.position.copy()
    reports = run(moving, 2.0)
    # A millionth of a box's side.
    assert np.abs(moving.position - start).max() <= 1e-6
    assert max(report.residual for report in reports) <= 1e-8
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
