"""Fixtures for the tests of another project: its own solver against the contract, and against its own baseline.

In the `conftest.py` at the root of that project:

    pytest_plugins = ["harness.pytest_plugin"]

and in its tests:

    def test_my_solver_keeps_the_contract(check_solver):
        check_solver(MySolver())

    def test_my_solver_got_no_worse(impact_gate):
        impact_gate("my_law.py:MySolver", baseline="baselines/my_law.json")
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import pytest

from harness import baseline as gate
from harness import conformance
from harness.environment import describe_environment
from harness.isolation import Limits
from harness.run import measure
from harness.store import Store
from solvers import Solver


class ImpactGate(Protocol):
    """Measures a solver and compares it with a baseline."""

    def __call__(self, solver: str, *, baseline: str | os.PathLike[str], jobs: int = 1) -> gate.Comparison:
        """Compare one solver with its entries in a baseline.

        Args:
            solver: specification, as on the command line.
            baseline: file that `impactbench accept` wrote.
            jobs: tasks at a time.

        Raises:
            AssertionError: a number got worse, or an answer is missing; the text lists all of them.
            BaselineError: the file cannot be used, is of another kind of machine, or has no entry of this solver.
        """
        ...


@pytest.fixture(scope="session")
def check_solver() -> Callable[[Solver], None]:
    """The conformance kit: every point of the contract on every small problem."""
    return conformance.check_solver


@pytest.fixture
def impact_gate(tmp_path: Path) -> ImpactGate:
    """The regression gate for one solver; what it measures lies in the test's temporary folder."""

    def check(solver: str, *, baseline: str | os.PathLike[str], jobs: int = 1) -> gate.Comparison:
        accepted = gate.read_baseline(Path(baseline))
        gate.check_same_kind(accepted, describe_environment())
        plan = gate.plan_gate(tier=accepted.tier, seed=accepted.seed, solvers=[solver])
        chosen = sorted({planned.task.solver for planned in plan})
        gate.gated_entries(accepted, chosen)
        measure(
            tmp_path / "impact_gate", plan, seed=accepted.seed, jobs=jobs, limits=Limits(), command="pytest",
            tier=accepted.tier, on_progress=lambda progress: None,
        )  # fmt: skip
        with Store.open(tmp_path / "impact_gate") as store:
            comparison = gate.compare(
                accepted, gate.collect(store, plan), environment=gate.latest_environment(store), solvers=chosen
            )
        if comparison.failures:
            raise AssertionError("\n".join(difference.sentence for difference in comparison.failures))
        return comparison

    return check
