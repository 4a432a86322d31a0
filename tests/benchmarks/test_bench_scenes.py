"""Speed of the scenes of rigid bodies: steps a second, contacts and sweeps; `pytest -m long -s tests/benchmarks`.

Processor time of one thread, over the steps in which the most happens: cards that stand, cards that fall, bunnies that
pile up, the machine's first second and its cards in collapse.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from scenarios.moving import MOVING
from solvers.qce_lcp import QceLcp

pytestmark = pytest.mark.long

LAW = QceLcp(tolerance=1e-9, max_sweeps=1000)
# Steps that are timed; the first ones, in which kernels are compiled, are not.
STEPS, WARM = 500, 5


@dataclass(frozen=True)
class Case:
    """A stretch of a scene."""

    name: str
    parameters: dict[str, float]
    start: float
    """Time from which it is timed [s]."""


CASES = {
    "cards that stand": Case("card-house", {}, 0.0),
    "cards that fall": Case("card-house", {"hit_at": 0.0}, 1.8),
    "bunnies on the ground": Case("bunnies-and-pawns", {}, 1.0),
    "the machine, all at rest": Case("rube-goldberg", {}, 0.0),
    "the machine, cards in collapse": Case("rube-goldberg", {}, 3.3),
}


@pytest.mark.parametrize("case", CASES)
def test_speed_of_a_scene(case: str) -> None:
    chosen = CASES[case]
    family: Callable[..., object] = MOVING[chosen.name]
    world = family(**chosen.parameters).world(solver=LAW)  # type: ignore[attr-defined]
    for _ in range(WARM):
        world.step()
    while world.time < chosen.start:
        world.step()
    begin = time.process_time()
    reports = [world.step() for _ in range(STEPS)]
    spent = time.process_time() - begin
    contacts, sweeps, residual = (
        np.array([getattr(report, name) for report in reports], dtype=np.float64)
        for name in ("contacts", "iterations", "residual")
    )
    print(
        f"\n{case}: {STEPS / spent:.0f} steps/s, {1e3 * spent / STEPS:.1f} ms a step; contacts {contacts.mean():.0f} "
        f"(at most {contacts.max():.0f}), iterations {sweeps.mean():.0f} (at most {sweeps.max():.0f}), "
        f"residual {np.median(residual):.1e} (at most {residual.max():.1e})"
    )
    assert contacts.max() > 0
    assert np.isfinite(residual).all()
