"""Work and error of explicit Hertz impulses beside QCE and GR on dense layers; `pytest -m long tests/benchmarks`.

Each case notes its rms velocity error (per sphere, against the compliant reference with full gap memory) where the
reference is affordable, and the contacts visited, beside the time.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np
import pytest

from scenarios.packs import sphere_pack
from solvers import SOLVERS, ImpactProblem, Status
from solvers.explicit_hertz import ExplicitHertz
from solvers.hertz import Hertz
from solvers.solution import Floats, Solver

pytestmark = pytest.mark.long

# Beyond this size the reference takes more than a minute.
REFERENCE_SPHERES = 4000
REFERENCE_STEPS = 100.0
# steps_per_contact and gap_memory that belong together: neither error is far below the other.
SETTINGS = ((1.75, 0.3), (2.0, 0.2), (2.5, 0.1), (3.0, 0.05), (4.0, 0.03), (8.0, 0.01))
ENERGY = 1e-13


@cache
def layer(spheres: int, start: str) -> ImpactProblem:
    problem = sphere_pack(spheres=spheres, start=start).problem
    # What every law would share is made before the clock runs.
    assert problem.W_diagonal.size == problem.u_pre.size == problem.JT.shape[1] == problem.MJT.shape[1]
    return problem


@cache
def reference(spheres: int, start: str) -> Floats:
    law = Hertz(steps_per_contact=REFERENCE_STEPS, max_visits=2_000_000_000)
    return law.solve(layer(spheres, start)).v_post


def measure(benchmark: Any, law: Solver, spheres: int, start: str) -> None:
    problem = layer(spheres, start)
    solution = benchmark.pedantic(law.solve, args=(problem,), rounds=5, warmup_rounds=1)
    assert solution.status is Status.CONVERGED
    energy = problem.kinetic_energy(solution.v_post) / problem.kinetic_energy(problem.v_pre) - 1.0
    benchmark.extra_info.update(contacts=problem.m, visits=solution.visits, energy_error=energy)
    if spheres <= REFERENCE_SPHERES:
        error = solution.v_post - reference(spheres, start)
        benchmark.extra_info["rms_error"] = float(np.sqrt(3.0 * np.mean(error**2)))


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", [300, 1000, 4000, 15_000, 60_000])
@pytest.mark.parametrize(("steps", "gap_memory"), SETTINGS)
@pytest.mark.parametrize("threads", [1, 2])
def test_ehi(benchmark: Any, spheres: int, start: str, steps: float, gap_memory: float, threads: int) -> None:
    available = numba.get_num_threads()
    if threads > available:
        pytest.skip(f"this machine has fewer than {threads} cores")
    numba.set_num_threads(threads)
    try:
        measure(benchmark, ExplicitHertz(steps_per_contact=steps, gap_memory=gap_memory), spheres, start)
    finally:
        numba.set_num_threads(available)
    assert abs(benchmark.extra_info["energy_error"]) <= ENERGY


@pytest.mark.parametrize("start", ["kick", "hot"])
@pytest.mark.parametrize("spheres", [300, 1000, 4000, 15_000, 60_000])
@pytest.mark.parametrize("law", ["qce", "gr"])
def test_peers(benchmark: Any, law: str, spheres: int, start: str) -> None:
    measure(benchmark, SOLVERS[law](), spheres, start)
