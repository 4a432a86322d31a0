"""Moving scenes at full size: `pytest -m long -s tests/benchmarks/test_bench_world.py` prints the tables.

- a whole step of 60,000 vibrated grains and its parts, on one thread and on two, beside Table 2 of Zhang 2015 (seconds
  in contact resolving, average / maximum, on one thread of a 3.0 GHz i5-2320);
- the error of few sweeps of the LCP with friction, against a thousand;
- the residual of a bed at rest by sweeps, and what they cost;
- energy, overlaps and pattern of a smaller layer, by sweeps and by time step.

The steps of one run are taken in turns by one thread and by two, which give the same bits: neighboring steps cost the
same, so that what else runs on the machine disturbs both alike. Times are noted and printed, never asserted.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numba
import numpy as np
import pytest

from scenarios.granular import extended_pattern, granular_shake
from scenarios.world import impact as impacts
from scenarios.world import stepping
from scenarios.world.checkpoint import checkpoint, resume
from scenarios.world.grid import Neighbors
from scenarios.world.impact import Streamed
from scenarios.world.stepping import StepReport, World
from solvers import Status

pytestmark = pytest.mark.long

CYCLES = 2
PARTS: dict[str, tuple[Any, str]] = {
    "pairs": (Neighbors, "touching"),
    "their list": (stepping, "find_neighbors"),
    "QCE": (impacts, "solve_spheres"),
    "LCP": (impacts, "sweep_spheres"),
    "velocities": (impacts, "_relative_velocity"),
    "fall": (stepping, "_fall"),
    "correction": (stepping, "_push_apart"),
    "move": (stepping, "_move"),
}
PAPER = {
    "squares": "13/46/1 iterations, 0.28/2.74 s",
    "stripes": "17/44/1 iterations, 0.33/4.39 s",
    "hexagons": "12/33/1 iterations, 0.25/2.87 s",
}
"""Table 2 of Zhang 2015: average/maximum/minimum, average/maximum."""
THREADS = (1, 2)
# The error is measured at so many steps of the two cycles, evenly spread: an accurate answer takes seconds.
SAMPLES = 16
SWEEPS = (2, 6, 10, 20, 50, 100)
ACCURATE = Streamed(max_sweeps=1_000, tolerance=1e-9)
# A grain whose velocity is off by more than this is told apart from those that few sweeps serve as well [√(gD)].
OFF = 0.01
# A layer of 15,000 grains for what takes long and does not depend on the size.
SMALLER = 50
PATTERN_CYCLES = 30
# Tangential restitution by that of the normal: Zhang 2015, with one number at all speeds, has none; else Bizon's.
BIZON = 0.35
# The bed of `granular-shake` lies from here on [√(D/g)]; so many steps are measured.
LYING = 25.0
LYING_STEPS = 40


class Stopwatch:
    """CPU time of all threads and wall time of the parts of a step [s], by number of threads."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.spent: dict[tuple[str, int], Any] = defaultdict(lambda: np.zeros(2))
        for part, (module, name) in PARTS.items():
            monkeypatch.setattr(module, name, self.timed(part, getattr(module, name)))

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **settings: Any) -> Any:
            begin = np.array([time.process_time(), time.perf_counter()])
            result = function(*args, **settings)
            self.spent[part, numba.get_num_threads()] += [time.process_time(), time.perf_counter()] - begin
            return result

        return timed


@cache
def settled(pattern: str, restitution: float | None, side: int) -> bytes:
    """A scene after two cycles."""
    world = started(pattern, restitution, side)
    for _ in range(steps_of(world)):
        world.step()
    return checkpoint(world)


def started(pattern: str, restitution: float | None, side: int) -> World:
    rebound = BIZON if restitution is None else 0.0
    world = extended_pattern(
        pattern=pattern, restitution=restitution, side=side, tangential_restitution=rebound
    ).world()
    assert isinstance(world, World)
    return world


def resumed(pattern: str, restitution: float | None, side: int) -> World:
    world = started(pattern, restitution, side)
    resume(world, settled(pattern, restitution, side))
    return world


def steps_of(world: World) -> int:
    """Steps in the two cycles in which a pattern repeats."""
    return round(CYCLES * world.period / world.settings.step)


@pytest.mark.parametrize("restitution", [0.3, None])
@pytest.mark.parametrize("pattern", ["squares", "stripes", "hexagons"])
def test_step(benchmark: Any, monkeypatch: pytest.MonkeyPatch, pattern: str, restitution: float | None) -> None:
    available = numba.get_num_threads()
    if max(THREADS) > available:
        pytest.skip(f"this machine has fewer than {max(THREADS)} cores")
    world = resumed(pattern, restitution, 100)
    watch = Stopwatch(monkeypatch)
    step = watch.timed("whole step", world.step)
    reports: list[StepReport] = []
    walls: dict[int, list[float]] = {threads: [] for threads in THREADS}

    def take() -> None:
        threads = THREADS[len(reports) % len(THREADS)]
        numba.set_num_threads(threads)
        begin = time.perf_counter()
        reports.append(step())
        walls[threads].append(1e3 * (time.perf_counter() - begin))

    try:
        # What is compiled for each number of threads is not part of a step.
        for _ in THREADS:
            take()
        reports.clear()
        watch.spent.clear()
        for wall in walls.values():
            wall.clear()
        benchmark.pedantic(take, rounds=steps_of(world))
    finally:
        numba.set_num_threads(available)
    iterations = np.array([report.iterations for report in reports])
    contacts = np.array([report.contacts for report in reports])
    print(f"\n{pattern}, {'restitution by speed' if restitution is None else f'c_r = {restitution:g}'}")
    print(f"{contacts.mean():.0f} contacts a step, at most {contacts.max()}")
    print(f"iterations {iterations.mean():.1f}/{iterations.max()}/{iterations.min()}; paper: {PAPER[pattern]}")
    for part in ("whole step", *PARTS):
        cells = []
        for threads in THREADS:
            cpu, wall = 1e3 * watch.spent[part, threads] / len(walls[threads])
            cells.append(f"{threads} thread{'s'[: threads - 1]}: {cpu:6.2f} ms CPU, {wall:6.2f} ms wall")
            benchmark.extra_info[f"{part}, {threads}"] = [cpu, wall]
        print(f"{part:12s}", "   ".join(cells))
    for threads in THREADS:
        taken = np.array(walls[threads])
        median, mean, worst = np.median(taken), taken.mean(), taken.max()
        print(f"wall of a step, threads: {threads}: median {median:.2f} ms, mean {mean:.2f} ms, longest {worst:.2f} ms")
    assert len(reports) == steps_of(world)


@pytest.mark.parametrize("restitution", [0.3, None])
def test_error_of_few_sweeps(benchmark: Any, monkeypatch: pytest.MonkeyPatch, restitution: float | None) -> None:
    """Against a thousand sweeps: rms of the velocity error [√(gD)], and the share of grains off by more than `OFF`."""
    world = resumed("hexagons", restitution, SMALLER)
    tried = [(sweeps, factor) for factor in (impacts.OVERSHOOT, 1.0) for sweeps in SWEEPS]
    errors: dict[tuple[int, float], list[float]] = {way: [] for way in tried}
    shares: dict[tuple[int, float], list[float]] = {way: [] for way in tried}
    residuals = []
    for step in range(steps_of(world)):
        if step % (steps_of(world) // SAMPLES) == 0:
            accurate = world.impact()
            residuals.append(ACCURATE.resolve(accurate).residual)
            for sweeps, factor in tried:
                impact = world.impact()
                with monkeypatch.context() as patch:
                    patch.setattr(impacts, "OVERSHOOT", factor)
                    Streamed(max_sweeps=sweeps, least_visits=0).resolve(impact)
                square = ((impact.motion - accurate.motion)[:-1, :3] ** 2).sum(axis=1)
                errors[sweeps, factor].append(float(np.sqrt(square.mean())))
                shares[sweeps, factor].append(float((square > OFF**2).mean()))
        world.step()
    impact = world.impact()
    law = Streamed()
    benchmark.pedantic(lambda: law.resolve(replace(impact, motion=impact.motion.copy())), rounds=5)
    print(
        f"\nhexagons, side {SMALLER} D, restitution {restitution}; "
        f"largest residual of the reference {max(residuals):.1e}"
    )
    for sweeps, factor in tried:
        error, share = np.array(errors[sweeps, factor]), np.mean(shares[sweeps, factor])
        print(
            f"{sweeps:4d} sweeps, overshoot {factor:g}: rms error median {np.median(error):.2e}, "
            f"mean {error.mean():.2e}, largest {error.max():.2e}; grains off by {OFF:g}: {share:.2%}"
        )
        benchmark.extra_info[f"{sweeps} sweeps, {factor:g}"] = [float(error.mean()), float(error.max()), float(share)]
    assert np.isfinite([*errors.values()]).all()
    # The answer is the same; on the way the error of many sweeps is less than that of few.
    for factor in (impacts.OVERSHOOT, 1.0):
        assert np.mean(errors[SWEEPS[-1], factor]) < np.mean(errors[SWEEPS[0], factor])


@cache
def lying() -> bytes:
    """The bed of `granular-shake` before the shake."""
    world = granular_shake().world(solver=Streamed())
    while world.time < LYING:
        world.step()
    return checkpoint(world)


@pytest.mark.parametrize("sweeps", [6, 60, 600])
def test_residual_of_what_lies(benchmark: Any, sweeps: int) -> None:
    """4,000 grains at rest, with the last step's impulses as the first guess; twice as many sweeps are made."""
    world = granular_shake().world(solver=Streamed())
    assert isinstance(world, World)
    resume(world, lying())
    world.resolver = Streamed(max_sweeps=sweeps)
    reports: list[StepReport] = []
    begin = time.process_time()
    benchmark.pedantic(lambda: reports.append(world.step()), rounds=LYING_STEPS)
    cost = 1e3 * (time.process_time() - begin) / LYING_STEPS
    residual = np.array([report.residual for report in reports])
    converged = np.mean([report.status is Status.CONVERGED for report in reports])
    print(
        f"\n{reports[-1].contacts} contacts, {reports[-1].sweeps} sweeps: residual median {np.median(residual):.1e}, "
        f"largest {residual.max():.1e}, converged {converged:.0%}; {cost:.1f} ms CPU a step; "
        f"kinetic energy at last {reports[-1].energy.kinetic:.1e} mgD"
    )
    benchmark.extra_info["residual"], benchmark.extra_info["CPU"] = [float(r) for r in residual], cost
    assert np.isfinite(residual).all()


@pytest.mark.parametrize(("sweeps", "steps_per_cycle"), [(6, 400), (60, 400), (6, 800)])
def test_what_accuracy_does_to_a_pattern(benchmark: Any, sweeps: int, steps_per_cycle: int) -> None:
    """Energy, overlaps and pattern of a layer by sweeps and by step; the means are over its later cycles."""
    scene = extended_pattern(pattern="hexagons", side=SMALLER, steps_per_cycle=steps_per_cycle)
    world = scene.world(solver=Streamed(max_sweeps=sweeps))
    reports: list[StepReport] = []
    measures: list[dict[str, float]] = []

    def take() -> None:
        reports.append(world.step())
        if world.steps % steps_per_cycle == 0:
            measures.append(dict(scene.measure(world)))

    benchmark.pedantic(take, rounds=PATTERN_CYCLES * steps_per_cycle)
    found = {name: np.array([measure[name] for measure in measures]) for name in measures[0]}
    overlap = np.array([report.overlap for report in reports]).reshape(PATTERN_CYCLES, -1)
    found["deepest overlap [radii]"] = overlap.max(axis=1)
    for name in ("impact", "friction", "correction", "shaking", "integration"):
        joule = np.array([getattr(report.energy, name) for report in reports]).reshape(PATTERN_CYCLES, -1)
        found[f"{name} a grain and cycle [mgD]"] = joule.sum(axis=1) / world.spheres.count
    residual = np.array([report.residual for report in reports])
    made = np.mean([report.sweeps for report in reports])
    print(f"\n{sweeps} sweeps, {steps_per_cycle} steps a cycle: {made:.1f} sweeps a step")
    print(f"residual: median {np.median(residual):.1e}, 99 % below {np.quantile(residual, 0.99):.1e}")
    for name, values in found.items():
        later = values[PATTERN_CYCLES // 2 :]
        print(f"{name:35s} mean {later.mean():8.4f} ± {later.std():.4f}, most {later.max():8.4f}")
        benchmark.extra_info[name] = [float(value) for value in values]
    assert overlap.max() < 1.0
