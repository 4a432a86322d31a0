"""Speed of rigid bodies: steps a second, contacts, sweeps and residuals of plates that stand and of stacks.

`pytest -m long -s tests/benchmarks/test_bench_rigid.py` prints the table. Times are those of one thread's CPU.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from scenarios.card_house import card_house
from scenarios.world.rigid_bodies import RigidBody
from scenarios.world.rigid_world import RigidWorld
from solvers.qce_lcp import QceLcp
from tests.rigid_scenes import CUBE, floor, world

SOLVER = QceLcp(tolerance=1e-6, max_sweeps=1000)
# Steps in which kernels are compiled and the scene settles, and steps that are timed.
SETTLING, TIMED = 200, 300


def stack(count: int) -> RigidWorld:
    return world([floor(), *(RigidBody(f"box {k}", CUBE, (0.0, 0.0, 0.5 + k)) for k in range(count))], SOLVER)


def plates() -> RigidWorld:
    """24 plates of a card house that stands."""
    house = card_house().world(solver=SOLVER)
    assert isinstance(house, RigidWorld)
    return house


def drop() -> RigidWorld:
    """12 boxes that fall on one another, turned at random."""
    random = np.random.default_rng(0)
    boxes = [
        RigidBody(f"box {k}", CUBE, (0.4 * (k % 3), 0.3 * (k % 2), 1.0 + 1.8 * k), random.normal(size=4))
        for k in range(12)
    ]
    return world([floor(), *boxes], SOLVER)


SCENES: dict[str, Callable[[], RigidWorld]] = {
    "one box": lambda: stack(1),
    "24 plates of a card house": plates,
    "stack of 10": lambda: stack(10),
    "stack of 50": lambda: stack(50),
    "12 boxes falling": drop,
}


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
def test_steps_per_second(scene: str, capsys: pytest.CaptureFixture[str]) -> None:
    moving = SCENES[scene]()
    for _ in range(SETTLING):
        moving.step()
    times, reports = [], []
    for _ in range(TIMED):
        begin = time.thread_time()
        reports.append(moving.step())
        times.append(time.thread_time() - begin)
    residual = [report.residual for report in reports]
    with capsys.disabled():
        print(
            f"\n{scene}: {TIMED / sum(times):.0f} steps/s, step {1e3 * np.median(times):.2f} ms median, "
            f"{1e3 * min(times):.2f} best; {np.mean([r.contacts for r in reports]):.0f} contacts, "
            f"{np.mean([r.iterations for r in reports]):.1f} iterations; residual {np.median(residual):.1e} median, "
            f"{max(residual):.1e} worst; converged {np.mean([r.status.name == 'CONVERGED' for r in reports]):.0%}; "
            f"overlap {max(r.overlap for r in reports):.1e} of the half thickness"
        )
    assert all(np.isfinite(report.energy.kinetic) for report in reports)
