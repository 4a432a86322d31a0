"""The conformance kit: every law of the registry passes it, and every way to break the contract fails its own point."""

from __future__ import annotations

import random
import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from harness.conformance import POINTS, check_solver, parametrize_with_checks, solver_checks
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem
from solvers.solution import Floats

pytest_plugins = ["harness.pytest_plugin"]

SEEN: list[ImpactProblem] = []
"""The memory of a law that must have none."""


@dataclass(frozen=True)
class Honest:
    """Reflect one approaching contact after the other, in order: a poor law that keeps the contract."""

    tolerance: float = 1e-10
    max_iterations: int = 60

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        if (problem.restitution != 1.0).any() or problem.has_friction:
            raise UnsupportedProblem("elastic and frictionless only")
        return self.propagate(problem, self.tolerance * problem.speed)

    def propagate(self, problem: ImpactProblem, tolerance: float) -> ImpactSolution:
        W, u = problem.W.toarray(), problem.u_pre.copy()
        impulse = np.zeros(problem.m)
        iterations = visits = 0
        while (u < -tolerance).any() and iterations < self.max_iterations:
            iterations += 1
            for i in range(problem.m):
                visits += 1
                if u[i] < -tolerance:
                    p = -2.0 * u[i] / W[i, i]
                    impulse[i] += p
                    u += p * W[i]
        v_post = problem.v_after(impulse)
        done = (problem.J @ v_post).min(initial=0.0) >= -10 * tolerance
        return ImpactSolution(
            impulse, v_post, Status.CONVERGED if done else Status.ITERATION_LIMIT, iterations, visits
        )  # fmt: skip


@parametrize_with_checks([Honest(), Honest(tolerance=1e-9)])
def test_a_poor_but_honest_law_passes_check_by_check(check: Callable[[], None]) -> None:
    check()


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_every_law_of_the_registry_conforms(name: str, check_solver: Callable[[Solver], None]) -> None:
    check_solver(SOLVERS[name]())


def test_every_point_of_the_contract_is_checked() -> None:
    # One that takes a start: the point about it is for those alone.
    names = [name for name, _ in solver_checks(SOLVERS["lcp-pgs"]())]
    assert {int(name.split()[0]) for name in names} == set(POINTS)
    assert len(set(names)) == len(names)


def test_the_points_are_those_of_the_protocol() -> None:
    assert Solver.__doc__ is not None
    numbered = [line.split(".")[0].strip() for line in Solver.__doc__.splitlines()]
    assert [int(number) for number in numbered if number.isdigit()] == list(POINTS)


def spoiled(solve: object) -> Solver:
    """The honest law with another `solve`."""
    law: Any = type("Spoiled", (Honest,), {"solve": solve})
    made: Solver = dataclass(frozen=True)(law)()
    return made


def changed(change: Callable[[ImpactProblem, ImpactSolution], object]) -> Callable[[Honest, ImpactProblem], object]:
    """A `solve` that spoils an honest answer."""
    return lambda self, problem: change(problem, Honest.solve(self, problem))


def nudged(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    return replace(solution, v_post=solution.v_post + 1e-6 * problem.speed)


def first_contact_only(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    once = replace(self, max_iterations=1)
    return replace(Honest.solve(once, problem), status=Status.CONVERGED)


def with_noise(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    # With a private generator: nothing global shows it.
    return replace(solution, visits=solution.visits + secrets.randbits(60))


def overwriting(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    problem.v_pre[:] = 0.0
    return Honest.solve(self, problem)


def unlocking(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    solution = Honest.solve(self, problem)
    problem.stiffness.flags.writeable = True
    problem.stiffness[:] *= 2.0
    return solution


def remembering(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    before = SEEN[-2].m if len(SEEN) > 1 else 0
    SEEN.append(problem)
    solution = Honest.solve(self, problem)
    return replace(solution, iterations=solution.iterations + before)


def drawing(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    np.random.random()  # noqa: NPY002  the fault that is looked for
    return solution


def rolling(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    random.random()
    return solution


def pushing_always(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    if problem.m and not solution.iterations:
        impulse = np.full(problem.m, 1e-12)
        return ImpactSolution(impulse, problem.v_after(impulse), Status.CONVERGED, 1, problem.m)
    return solution


def in_meters_per_second(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    Honest.solve(self, problem)
    return self.propagate(problem, 1e-7)


def raising_when_it_gets_hard(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    if solution.status is not Status.CONVERGED:
        raise RuntimeError("did not converge")
    return solution


def ignoring_everything(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    return Honest.solve(self, problem.replace(restitution=1.0, friction=0.0))


def ignoring_friction(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    solution = Honest.solve(self, problem.replace(friction=0.0))
    return replace(solution, friction_impulse=np.zeros(2 * problem.m) if problem.has_friction else None)


def ignoring_restitution(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    return Honest.solve(self, problem.replace(restitution=1.0))


def raising_on_friction(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    if problem.has_friction:
        raise NotImplementedError("friction")
    return Honest.solve(self, problem)


def refusing_all(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    raise UnsupportedProblem("not today")


def refusing_without_reason(self: Honest, problem: ImpactProblem) -> ImpactSolution:
    raise UnsupportedProblem


def not_a_number(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    return replace(solution, v_post=solution.v_post * np.nan)


def counting_halves(problem: ImpactProblem, solution: ImpactSolution) -> ImpactSolution:
    half: Any = solution.visits / 2
    return replace(solution, visits=half)


def adding_to_its_start(self: Honest, problem: ImpactProblem, *, start: Floats | None = None) -> ImpactSolution:
    solution = Honest.solve(self, problem)
    if start is None or solution.impulse is None:
        return solution
    impulse = solution.impulse + start
    # No claim to have converged: the fault is the start alone.
    return replace(solution, impulse=impulse, v_post=problem.v_after(impulse), status=Status.STALLED)


def refusing_a_start(self: Honest, problem: ImpactProblem, *, start: Floats | None = None) -> ImpactSolution:
    if start is not None:
        raise UnsupportedProblem("no start")
    return Honest.solve(self, problem)


FAULTS: dict[str, tuple[int, str, object]] = {
    "noise": (1, "one after the other differ in visits", changed(with_noise)),
    "overwriting": (2, "writes to the problem", overwriting),
    "unlocking": (2, "changed the problem: stiffness", unlocking),
    "remembering": (2, "before and after solving", remembering),
    "global NumPy generator": (2, "global random generator", changed(drawing)),
    "global Python generator": (2, "global random generator", changed(rolling)),
    "wrong type": (3, "must return an ImpactSolution", changed(lambda problem, solution: solution.v_post)),
    "wrong shape": (3, "v_post must have shape", changed(lambda _, s: replace(s, v_post=s.v_post[:-1]))),
    "NaN": (3, "must be finite", changed(not_a_number)),
    "velocity without its impulse": (3, "v_post differs", changed(nudged)),
    "pushing always": (4, "no contact approaches", changed(pushing_always)),
    "absolute tolerance": (5, "a tolerance is absolute", in_meters_per_second),
    "claims to have converged": (6, "it says converged, and unanswered approach", first_contact_only),
    "raises when it gets hard": (6, "RuntimeError: did not converge", changed(raising_when_it_gets_hard)),
    "ignores friction and restitution": (3, "friction_impulse must have shape", ignoring_everything),
    "ignores friction": (7, "slides as fast", ignoring_friction),
    "ignores restitution": (7, "without this restitution must refuse", ignoring_restitution),
    "raises on friction": (7, "NotImplementedError: friction", raising_on_friction),
    "refuses all": (7, "nothing could be checked", refusing_all),
    "refuses without a reason": (7, "without a reason", refusing_without_reason),
    "counts nothing": (8, "must count the work", changed(lambda _, s: replace(s, iterations=0, visits=0))),
    "counts in floats": (8, "visits must be an integer", changed(counting_halves)),
    "adds to its start": (9, "started from its own answer", adding_to_its_start),
    "refuses a start": (9, "refuses to start", refusing_a_start),
}
"""What is wrong → the point of the contract that it breaks, what the message says, and the `solve` that does it."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_solver_fails_its_own_point(fault: str) -> None:
    point, words, solve = FAULTS[fault]
    SEEN.clear()
    broken = spoiled(solve)
    with pytest.raises(AssertionError, match=rf"contract point {point} \({POINTS[point]}\), problem '.*{words}"):
        check_solver(broken)


@pytest.mark.parametrize("fault", ["absolute tolerance", "ignores friction", "counts nothing"])
def test_other_points_than_the_broken_one_are_still_told_apart(fault: str) -> None:
    # Not one fault makes everything fail: a report by parametrized tests shows where it lies.
    point, _, solve = FAULTS[fault]
    broken = spoiled(solve)
    passed, failed = set(), set()
    for name, check in solver_checks(broken):
        SEEN.clear()
        try:
            check()
        except AssertionError as error:
            failed.add(str(error).split()[2])
        else:
            passed.add(name.split()[0])
    assert str(point) in failed
    assert passed


class NoDataclass(Honest):
    """Its settings are those of its parent, and `mood` is none of them."""

    def __init__(self) -> None:
        super().__init__()
        object.__setattr__(self, "mood", object())

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = None  # type: ignore[assignment]


@dataclass
class Thawed:
    """A dataclass that can be changed."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return Honest().solve(problem)


@dataclass(frozen=True)
class WithoutDefault:
    """A setting that must be given."""

    tolerance: float

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return Honest(self.tolerance).solve(problem)


class Plain:
    """No dataclass at all."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return Honest().solve(problem)


@pytest.mark.parametrize(
    ("solver", "words"),
    [
        (NoDataclass(), "are not equal"),
        (Thawed(), "is not frozen"),
        (WithoutDefault(1e-10), "tolerance has no default"),
        (Plain(), "is no dataclass"),
    ],
)
def test_settings_are_fields_of_a_frozen_dataclass(solver: Solver, words: str) -> None:
    with pytest.raises(AssertionError, match=rf"contract point 1 \(settings\), .*{words}"):
        check_solver(solver)


def test_an_exit_of_a_solver_passes_through_with_a_note() -> None:
    def leave(self: Honest, problem: ImpactProblem) -> ImpactSolution:
        raise SystemExit(3)

    broken = spoiled(leave)
    with pytest.raises(SystemExit) as caught:
        check_solver(broken)
    assert any("contract point" in note for note in caught.value.__notes__)


def test_the_decorator_names_every_check() -> None:
    mark = parametrize_with_checks([Honest(), SOLVERS["qce"]()]).mark
    assert mark.args[0] == "check"
    assert len(mark.args[1]) == len(mark.kwargs["ids"]) == 2 * len(list(solver_checks(Honest())))
    assert any(name.startswith("QuadraticContactEnergy: 5 units") for name in mark.kwargs["ids"])
