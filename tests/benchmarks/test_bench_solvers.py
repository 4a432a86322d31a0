"""Cost of QCE, GR and the LCP methods on dense sphere layers; `pytest -m long tests/benchmarks/test_bench_solvers.py`.

Targets are ratios within one run, as machines and their load differ: an event of QCE (the end of one contact in one
outer iteration) against a row visit of projected Gauss-Seidel on the same problem, timed in turn on one thread.
They are noted in `extra_info` and printed, never asserted; the energy error is.

Both find the packed rows made: a problem keeps them, they are made once for all laws. `packing_ms` is what that takes.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numba
import numpy as np
import pytest

from scenarios.hard import long_chain
from scenarios.packs import sphere_pack
from solvers import SOLVERS, ImpactProblem, Status, boxed_lcp, qce_stream
from solvers.generalized_reflections import GeneralizedReflections
from solvers.lcp_gradient import AcceleratedProjectedGradient, SpectralProjectedGradient
from solvers.lcp_qp import NewtonLcpClarabel, NewtonLcpOsqp
from solvers.newton_lcp import NewtonLcp
from solvers.qce_heap import solve_by_heap
from solvers.quadratic_contact_energy import QuadraticContactEnergy
from solvers.solution import Floats, Solver, UnsupportedProblem
from solvers.sphere_rows import pack, sphere_rows

pytestmark = pytest.mark.long

SPHERES = [1000, 4000, 15_000, 60_000]
ENERGY = 1e-13
TOLERANCE = 1e-10
# Interleaved repeats of QCE and Gauss-Seidel; their median ratio is what counts.
REPEATS = 7
# Sweeps between two checks of the residual, so that the difference to no sweep at all is row visits and nothing else.
SWEEPS = 40
# Interleaved repeats of a solve that takes seconds.
DEAR_REPEATS = 3
# Repeats of one exponent each, of which the interval of the exponent comes.
EXPONENT_REPEATS = 9
# Peak memory of a solve beyond what the process held before it: with the packed rows that the problem keeps from then
# on, and again when it has them. The kernel resets its peak.
MEMORY = """
import sys
from scenarios.packs import sphere_pack
from solvers.quadratic_contact_energy import QuadraticContactEnergy
def status(field):
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(field))
law = QuadraticContactEnergy()
law.solve(sphere_pack(spheres=4000).problem)
problem = sphere_pack(spheres=int(sys.argv[1]), start=sys.argv[2]).problem
problem.u_pre, problem.MJT
for _ in range(2):
    with open("/proc/self/clear_refs", "w") as peak:
        peak.write("5")
    before = status("VmRSS")
    solution = law.solve(problem)
    print((status("VmHWM") - before) / problem.m)
"""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """A law may share its work out among threads; what is compared here is work."""
    available = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(available)


@cache
def layer(spheres: int, start: str) -> ImpactProblem:
    problem = sphere_pack(spheres=spheres, start=start).problem
    # What every law would share is made before the clock runs.
    assert problem.W_diagonal.size == problem.u_pre.size == problem.JT.shape[1] == problem.MJT.shape[1]
    assert problem.DM.shape[0] == 2 * problem.m
    assert problem.spheres_at_rest is not None
    return problem


def seconds(work: Callable[[], object]) -> float:
    """CPU time of this thread for one call."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


@cache
def events(spheres: int, start: str) -> int:
    """Contact ends of a whole QCE solution."""
    problem = layer(spheres, start)
    rows = sphere_rows(problem)
    assert rows is not None
    total = 0
    while True:
        # Each call goes on from the velocities that the last one left.
        impulse, iterations, _, _ = qce_stream.solve_spheres(
            rows, threshold=TOLERANCE * problem.speed, defer=0.0, max_iterations=1
        )
        if iterations == 0:
            return total
        total += int(np.count_nonzero(impulse))


def wall_seconds(work: Callable[[], object]) -> float:
    """Time of the clock for one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def visit_seconds(problem: ImpactProblem) -> float:
    """CPU time of one row visit of projected Gauss-Seidel; what a call costs besides its sweeps is subtracted."""
    target = -problem.u_pre
    sweeping = seconds(lambda: boxed_lcp.sweep(problem, target, tolerance=0.0, max_sweeps=SWEEPS))
    idle = seconds(lambda: boxed_lcp.sweep(problem, target, tolerance=0.0, max_sweeps=0))
    return (sweeping - idle) / (problem.m * SWEEPS)


def energy_error(problem: ImpactProblem, v_post: Floats) -> float:
    return problem.kinetic_energy(v_post) / problem.kinetic_energy(problem.v_pre) - 1.0


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", SPHERES)
def test_an_event_of_qce_against_a_row_visit(benchmark: Any, spheres: int, start: str) -> None:
    problem = layer(spheres, start)
    law = QuadraticContactEnergy(tolerance=TOLERANCE)
    solution = benchmark.pedantic(law.solve, args=(problem,), rounds=3, warmup_rounds=1)
    assert solution.status is Status.CONVERGED
    ends = events(spheres, start)
    event = np.empty(REPEATS)
    visit = np.empty(REPEATS)
    for repeat in range(REPEATS):
        event[repeat] = seconds(lambda: law.solve(problem)) / ends
        visit[repeat] = visit_seconds(problem)
    error = energy_error(problem, law.solve(problem).v_post)
    packing = min(seconds(lambda: pack(problem.J, problem.inverse_mass)) for _ in range(DEAR_REPEATS))
    memory = subprocess.run(
        [sys.executable, "-c", MEMORY, str(spheres), start], check=True, capture_output=True, text=True
    ).stdout.split()
    benchmark.extra_info.update(
        contacts=problem.m,
        events=ends,
        iterations=solution.iterations,
        ms=float(event.min() * ends * 1e3),
        ns_per_event=float(event.min() * 1e9),
        ns_per_row_visit=float(visit.min() * 1e9),
        ratio=float(np.median(event / visit)),
        ratio_of_minimum=float(event.min() / visit.min()),
        energy_error=error,
        bytes_per_contact_with_packing=float(memory[0]),
        bytes_per_contact=float(memory[1]),
        packing_ms=packing * 1e3,
    )
    print(f"\nqce {start} {benchmark.extra_info}")
    assert abs(error) <= ENERGY


@pytest.mark.parametrize("start", ["kick", "hot"])
def test_the_exponent_of_time_over_contacts(benchmark: Any, start: str) -> None:
    law = QuadraticContactEnergy(tolerance=TOLERANCE)
    contacts = np.array([layer(spheres, start).m for spheres in SPHERES], dtype=float)
    times = np.full((EXPONENT_REPEATS, len(SPHERES)), np.inf)
    for repeat in range(EXPONENT_REPEATS):
        for column, spheres in enumerate(SPHERES):
            problem = layer(spheres, start)
            times[repeat, column] = seconds(lambda problem=problem: law.solve(problem))  # type: ignore[misc]
    slopes = np.polyfit(np.log(contacts), np.log(times.T), 1)[0]
    benchmark.pedantic(law.solve, args=(layer(SPHERES[0], start),), rounds=1)
    benchmark.extra_info.update(
        exponent_of_minimum=float(np.polyfit(np.log(contacts), np.log(times.min(axis=0)), 1)[0]),
        exponent_quartiles=[float(x) for x in np.percentile(slopes, [25, 50, 75])],
        ms=[float(x) for x in 1e3 * times.min(axis=0)],
    )
    print(f"\nexponent {start} {benchmark.extra_info}")


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", SPHERES[2:])
def test_qce_on_two_threads(benchmark: Any, spheres: int, start: str) -> None:
    problem = layer(spheres, start)
    law = QuadraticContactEnergy(tolerance=TOLERANCE)
    benchmark.pedantic(law.solve, args=(problem,), rounds=1, warmup_rounds=1)
    times = np.empty((REPEATS, 2))
    answers = []
    for repeat in range(REPEATS):
        for column, threads in enumerate((1, 2)):
            numba.set_num_threads(threads)
            times[repeat, column] = wall_seconds(lambda: answers.append(law.solve(problem)))
    benchmark.extra_info.update(
        contacts=problem.m,
        ms=[float(x) for x in 1e3 * times.min(axis=0)],
        gain_of_minimum=float(times[:, 0].min() / times[:, 1].min()),
        gain_median=float(np.median(times[:, 0] / times[:, 1])),
    )
    print(f"\nthreads {start} {benchmark.extra_info}")
    for answer in answers:
        np.testing.assert_array_equal(answer.v_post, answers[0].v_post)


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", SPHERES)
def test_the_heap_beside_the_stream(benchmark: Any, spheres: int, start: str) -> None:
    problem = layer(spheres, start)
    threshold = TOLERANCE * problem.speed
    impulse, iterations, visits, stalled = benchmark.pedantic(
        lambda: solve_by_heap(problem, threshold=threshold, defer=0.0, max_iterations=10_000),
        rounds=3,
        warmup_rounds=1,
    )
    error = energy_error(problem, problem.v_after(impulse))
    benchmark.extra_info.update(contacts=problem.m, iterations=iterations, visits=visits, energy_error=error)
    assert not stalled
    assert abs(error) <= ENERGY


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", SPHERES)
@pytest.mark.parametrize("inner_tolerance", [1e-4, 1e-9, 1e-13])
def test_generalized_reflections_beside_qce(benchmark: Any, spheres: int, start: str, inner_tolerance: float) -> None:
    problem = layer(spheres, start)
    law = GeneralizedReflections(tolerance=TOLERANCE, inner_tolerance=inner_tolerance)
    peer = QuadraticContactEnergy(tolerance=TOLERANCE)
    solution = benchmark.pedantic(law.solve, args=(problem,), rounds=1, warmup_rounds=1)
    peer.solve(problem)
    times = np.array(
        [
            [seconds(lambda: law.solve(problem)), seconds(lambda: peer.solve(problem)), visit_seconds(problem)]
            for _ in range(DEAR_REPEATS)
        ]
    )
    benchmark.extra_info.update(
        contacts=problem.m,
        iterations=solution.iterations,
        visits=solution.visits,
        status=str(solution.status),
        ms=1e3 * float(times[:, 0].min()),
        ns_per_visit=1e9 * float(times[:, 0].min()) / solution.visits,
        ratio_to_qce=float(np.median(times[:, 0] / times[:, 1])),
        ratio_to_qce_of_minimum=float(times[:, 0].min() / times[:, 1].min()),
        row_visits=float(np.median(times[:, 0] / times[:, 2])),
        energy_error=energy_error(problem, law.solve(problem).v_post),
    )
    print(f"\ngr {start} {inner_tolerance} {benchmark.extra_info}")


METHODS: dict[str, Callable[[float], Solver]] = {
    "lcp-pgs": lambda tolerance: NewtonLcp(tolerance=tolerance, max_iterations=2000),
    "lcp-apgd": lambda tolerance: AcceleratedProjectedGradient(tolerance=tolerance, max_iterations=4000),
    "lcp-spg": lambda tolerance: SpectralProjectedGradient(tolerance=tolerance, max_iterations=4000),
    "lcp-osqp": lambda tolerance: NewtonLcpOsqp(tolerance=tolerance),
    "lcp-clarabel": lambda tolerance: NewtonLcpClarabel(tolerance=tolerance),
}
# A factorization of 4,000 spheres takes tens of seconds.
FACTORIZED_SPHERES = 1000


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", SPHERES)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_time_to_a_residual(benchmark: Any, name: str, spheres: int, start: str, tolerance: float) -> None:
    if name in ("lcp-osqp", "lcp-clarabel") and spheres > FACTORIZED_SPHERES:
        pytest.skip("a factorization of this size takes minutes")
    problem = layer(spheres, start)
    solution = benchmark.pedantic(METHODS[name](tolerance).solve, args=(problem,), rounds=1)
    benchmark.extra_info.update(
        contacts=problem.m,
        iterations=solution.iterations,
        visits=solution.visits,
        residual=solution.residual,
        reached=bool(solution.residual <= tolerance),
        energy_error=energy_error(problem, solution.v_post),
        ms=1e3 * benchmark.stats.stats.min,
    )
    print(f"\n{name} {start} {tolerance} {benchmark.extra_info}")


@pytest.mark.parametrize("name", SOLVERS)
def test_how_each_law_ends_on_a_converging_chain(benchmark: Any, name: str) -> None:
    # Balls that all fly at the middle exchange their velocities pair by pair: n²/2 times in all for the exact laws.
    problem = long_chain(balls=100_000, start="converging").problem
    try:
        solution = benchmark.pedantic(SOLVERS[name]().solve, args=(problem,), rounds=1)
    except UnsupportedProblem as refusal:
        pytest.skip(str(refusal))
    benchmark.extra_info.update(
        status=str(solution.status),
        iterations=solution.iterations,
        visits=solution.visits,
        residual=solution.residual,
        seconds=benchmark.stats.stats.min,
    )
    print(f"\nchain {name} {benchmark.extra_info}")
    assert np.isfinite(solution.v_post).all()
