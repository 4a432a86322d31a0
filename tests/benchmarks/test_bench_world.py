"""A whole step of 60,000 vibrated grains, and what it is made of; `pytest -m long tests/benchmarks`.

μ = 0.5, c_r = 0.3 or the scene's own restitution that depends on speed; over the two cycles in which a pattern repeats,
after two that settle it. The iterations stand beside Table 2 of Zhang 2015 (average / maximum / minimum: squares
13/46/1, stripes 17/44/1, hexagons 12/33/1; seconds in contact resolving, average / maximum, on one thread of a 3.0 GHz
i5-2320: 0.28/2.74, 0.33/4.39, 0.25/2.87).
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest

from scenarios.granular import extended_pattern
from scenarios.world import impact as impacts
from scenarios.world import stepping
from scenarios.world.impact import Streamed
from scenarios.world.stepping import StepReport, World

pytestmark = pytest.mark.long

CYCLES = 2
PARTS = {
    "pairs": (stepping, "find_contacts"),
    "qce": (impacts, "solve_spheres"),
    "lcp": (impacts, "sweep_spheres"),
    "fall": (stepping, "_fall"),
    "correction": (stepping, "_push_apart"),
    "move": (stepping, "_move"),
}
ACCURATE = Streamed(max_sweeps=1_000, tolerance=1e-6)
# The error is measured at so many steps of the two cycles, evenly spread: an accurate answer takes seconds.
SAMPLES = 8


class Stopwatch:
    """Wall time of the parts of a step."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        for part, (module, name) in PARTS.items():
            monkeypatch.setattr(module, name, self._timed(part, getattr(module, name)))

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **settings: Any) -> Any:
            begin = time.perf_counter()
            result = function(*args, **settings)
            self.spent[part] += time.perf_counter() - begin
            return result

        return timed


def settled(pattern: str, restitution: float | None) -> World:
    """A scene after two cycles."""
    world = extended_pattern(pattern=pattern, restitution=restitution).world()
    assert isinstance(world, World)
    for _ in range(steps_of(world)):
        world.step()
    return world


def steps_of(world: World) -> int:
    """Steps in the two cycles in which a pattern repeats."""
    return round(CYCLES * world.period / world.settings.step)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("restitution", [0.3, None])
@pytest.mark.parametrize("pattern", ["squares", "stripes", "hexagons"])
def test_step(
    benchmark: Any, monkeypatch: pytest.MonkeyPatch, pattern: str, restitution: float | None, threads: int
) -> None:
    available = numba.get_num_threads()
    if threads > available:
        pytest.skip(f"this machine has fewer than {threads} cores")
    world = settled(pattern, restitution)
    watch = Stopwatch(monkeypatch)
    reports: list[StepReport] = []
    numba.set_num_threads(threads)
    steps = steps_of(world)
    cpu = time.process_time()
    try:
        benchmark.pedantic(lambda: reports.append(world.step()), rounds=steps)
    finally:
        numba.set_num_threads(available)
    cpu = time.process_time() - cpu
    iterations = np.array([report.iterations for report in reports])
    benchmark.extra_info.update(
        {f"{part}_ms": 1e3 * spent / steps for part, spent in watch.spent.items()},
        # Of all threads together: what other processes on the machine disturb least.
        cpu_ms=1e3 * cpu / steps,
        mean_ms=1e3 * benchmark.stats.stats.mean,
        max_ms=1e3 * benchmark.stats.stats.max,
        contacts=float(np.mean([report.contacts for report in reports])),
        iterations=[float(iterations.mean()), int(iterations.max()), int(iterations.min())],
        sweeps=float(np.mean([report.sweeps for report in reports])),
        residual=float(np.mean([report.residual for report in reports])),
    )
    assert len(reports) == steps


@pytest.mark.parametrize("restitution", [0.3, None])
@pytest.mark.parametrize("sweeps", [10, 100])
def test_error_of_few_sweeps(benchmark: Any, restitution: float | None, sweeps: int) -> None:
    """Root mean square of the velocity error, in √(gD), against a thousand sweeps."""
    world = settled("hexagons", restitution)
    errors = []
    residuals = []
    for step in range(steps_of(world)):
        if step % (steps_of(world) // SAMPLES) == 0:
            fast = world.impact()
            accurate = replace(fast, motion=fast.motion.copy())
            Streamed(max_sweeps=sweeps).resolve(fast)
            residuals.append(ACCURATE.resolve(accurate).residual)
            errors.append(np.sqrt(3.0 * np.mean((fast.motion - accurate.motion)[:, :3] ** 2)))
        world.step()
    impact = world.impact()
    law = Streamed(max_sweeps=sweeps)
    benchmark.pedantic(lambda: law.resolve(replace(impact, motion=impact.motion.copy())), rounds=5)
    benchmark.extra_info.update(
        error_mean=float(np.mean(errors)), error_max=float(np.max(errors)), accurate_residual=float(np.max(residuals))
    )
    assert np.isfinite(errors).all()
