"""Warm start: the sequence of impacts, and what starting from the last impulse saves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from harness.warm_start import FALL, STEPS, measure_warm_start, resting_layer, takes_start
from harness.work_precision import TIERS, WARM, choose_bench, plan_bench
from solvers import SOLVERS, UnsupportedProblem

SPHERES = 100
STARTED = sorted(name for name, law in SOLVERS.items() if takes_start(law()))
# Both answers meet the solver's own tolerance; a singular W lets neither be closer to the other than a few of those.
SAME_ANSWER = 1e-6


def test_the_layer_comes_to_creep_under_gravity_alone() -> None:
    problems = list(resting_layer(SPHERES))
    assert len(problems) == STEPS + 1
    fastest = [float(np.abs(problem.v_pre).max()) for problem in problems]
    assert fastest[0] == 1.0
    assert all(after < before for before, after in itertools.pairwise(fastest))
    # A sphere that slides down a slope of any steepness: half of its velocity stays, so it sums to twice the step's.
    assert fastest[-1] < 2 * FALL
    assert all((problem.restitution == 0.0).all() for problem in problems)


def test_laws_whose_answer_depends_on_the_way_take_no_start() -> None:
    assert not {"qce", "gr", "gauss-seidel", "jacobi", "hertz", "lzb", "ehi"} & set(STARTED)
    assert {"lcp-pgs", "lcp-apgd", "lcp-spg", "qce-lcp"} <= set(STARTED)


@pytest.mark.parametrize("name", STARTED)
def test_a_warm_start_saves_visits_and_changes_nothing_else(name: str) -> None:
    found = measure_warm_start(SOLVERS[name](), SPHERES)
    assert len(found.cold_s) == len(found.warm_s) == STEPS
    assert found.statuses == ("converged",)
    assert found.difference < SAME_ANSWER
    assert sum(found.warm_visits) < sum(found.cold_visits)


def test_a_solver_that_refuses_the_layer_says_so() -> None:
    class Elastic:
        def solve(self, problem: object, *, start: object = None) -> None:
            raise UnsupportedProblem("elastic impacts alone")

    with pytest.raises(UnsupportedProblem, match="elastic impacts alone"):
        measure_warm_start(Elastic(), SPHERES)  # type: ignore[arg-type]


def test_the_bench_plans_a_warm_start_for_those_that_take_one() -> None:
    solvers, scenes = choose_bench(["qce", "lcp-pgs"], [])
    warm = [planned for planned in plan_bench(solvers, tier="smoke", scenarios=scenes) if planned.task.scenario == WARM]
    assert {planned.task.solver for planned in warm} == {"lcp-pgs"}
    assert len(warm) == TIERS["smoke"].repeats
