"""Timing: what is counted and kept, never how long it takes."""

from __future__ import annotations

import gc
import sys
from dataclasses import dataclass, field

import numpy as np
import pytest

from harness import timing
from harness.timing import calibrate, is_noisy, time_first_solves, time_solver, unbuilt
from scenarios import CATALOG
from solvers import ImpactProblem, ImpactSolution, Status, UnsupportedProblem
from solvers.solution import Floats

MEBIBYTE = 2**20


@dataclass
class Counting:
    """A solver that leaves everything as it is, counts its calls, and remembers the problems."""

    problems: list[ImpactProblem] = field(default_factory=list)

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        self.problems.append(problem)
        return ImpactSolution(np.zeros(problem.m), problem.v_pre, Status.CONVERGED, 1, problem.m)


@dataclass
class Greedy:
    """A solver that needs memory, and touches it."""

    size: int

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        np.ones(self.size // 8).sum()
        return ImpactSolution(np.zeros(problem.m), problem.v_pre, Status.CONVERGED, 1, 1)


@dataclass
class Refusing:
    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        raise UnsupportedProblem("not today")


@pytest.fixture
def problem() -> ImpactProblem:
    return CATALOG["three-ball-chain"](va=0.5).problem


def test_every_sample_is_the_time_of_one_solve(problem: ImpactProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Counting()
    monkeypatch.setattr(timing, "MOST_SOLVES", 7)
    timed = time_solver(solver, problem, samples=4)
    assert len(timed.cpu_s) == len(timed.wall_s) == 4
    assert 1 <= timed.solves <= 7
    # One that compiles, the fresh one, the one that sets the length of a sample.
    assert len(solver.problems) == 3 + 4 * timed.solves
    assert timed.solution.status is Status.CONVERGED


def test_a_long_solve_is_sampled_once(problem: ImpactProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "LONG_S", 0.0)
    solver = Counting()
    timed = time_solver(solver, problem, samples=4)
    assert len(timed.cpu_s) == timed.solves == 1
    # One that compiles, the fresh one, the sample.
    assert len(solver.problems) == 3


def test_the_fresh_solve_meets_a_problem_that_nobody_solved_before(problem: ImpactProblem) -> None:
    solver = Counting()
    time_solver(solver, problem)
    compiled, fresh, warm = solver.problems[:3]
    assert compiled is not fresh
    assert fresh is warm


def test_an_unbuilt_problem_has_the_same_numbers_and_no_matrices(problem: ImpactProblem) -> None:
    _ = problem.W, problem.u_pre
    fresh = unbuilt(problem)
    assert "W" not in fresh.__dict__
    np.testing.assert_array_equal(fresh.u_pre, problem.u_pre)
    np.testing.assert_array_equal(fresh.W.toarray(), problem.W.toarray())
    np.testing.assert_array_equal(fresh.stiffness, problem.stiffness)


def test_friction_directions_survive_being_unbuilt() -> None:
    rubbing = CATALOG["bernoulli"](friction=0.3).problem.replace(tangential_restitution=0.35)
    fresh = unbuilt(rubbing)
    assert rubbing.D is not None
    assert fresh.D is not None
    np.testing.assert_array_equal(fresh.D.toarray(), rubbing.D.toarray())
    np.testing.assert_array_equal(fresh.friction, rubbing.friction)
    np.testing.assert_array_equal(fresh.slip_target, rubbing.slip_target)


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_memory_that_a_solve_takes_is_seen(problem: ImpactProblem) -> None:
    size = 64 * MEBIBYTE
    grown = time_solver(Greedy(size), problem, samples=1).memory_bytes
    # A page more or less at either end, and whatever the interpreter takes meanwhile.
    assert size - MEBIBYTE < grown < size + 16 * MEBIBYTE


def test_a_refusal_passes_through_and_leaves_the_garbage_collector_on(problem: ImpactProblem) -> None:
    with pytest.raises(UnsupportedProblem, match="not today"):
        time_solver(Refusing(), problem)
    assert gc.isenabled()


def test_first_and_second_solve_meet_problems_of_their_own(problem: ImpactProblem) -> None:
    solver = Counting()
    first, second = time_first_solves(solver, problem)
    assert len(solver.problems) == 2
    assert solver.problems[0] is not solver.problems[1]
    assert first >= 0
    assert second >= 0


@pytest.mark.kernels
def test_the_calibration_kernel_reads_every_entry_once() -> None:
    # Full period modulo a power of two: each entry is met once, so marks in all of them are all counted.
    entries: Floats = np.ones(1024)
    met = np.zeros(1024)
    i = 0
    for _ in range(1024):
        i = (i * 1664525 + 1013904223) & 1023
        met[i] += 1
    np.testing.assert_array_equal(met, entries)
    # total = total / 2 + 1 → 2 as the steps go on.
    assert timing._gather(entries, 60) == pytest.approx(2.0, abs=2.0**-50)


def test_calibration_takes_some_time() -> None:
    assert calibrate() > 0


def test_a_machine_is_noisy_where_the_kernel_is_slower_than_the_named_ratio() -> None:
    assert not is_noisy(timing.NOISE_RATIO, 1.0)
    assert is_noisy(1.001 * timing.NOISE_RATIO, 1.0)
