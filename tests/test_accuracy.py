"""Validation and verification errors on known answers, and residuals of the laws' own equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness import accuracy
from harness.measurement import Verdict
from harness.sweeps import chain, newton_lcp_of_chain
from scenarios.scenario import Quantity, Reference, ReferenceKind
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Status
from solvers.solution import Floats

# A handful of sums and products of numbers near one.
ROUNDING = 1e-14

three_balls = chain(np.array([0.5, 0.0, -1.0]))
EXACT = newton_lcp_of_chain(three_balls)


def reference(value: list[float], *, uncertainty: float = 0.0, laws: tuple[str, ...] = ()) -> Reference:
    return Reference("known", np.array(value), ReferenceKind.CLOSED_FORM, "by hand", uncertainty, laws=laws)


def count(value: float) -> Reference:
    kind = ReferenceKind.CLOSED_FORM
    return Reference("count", np.array([value]), kind, "by hand", 0.0, Quantity.ITERATIONS, laws=("qce",))


def solution(v_post: Floats, *, impulse: Floats | None = None, iterations: int = 3) -> ImpactSolution:
    return ImpactSolution(impulse, v_post, Status.CONVERGED, iterations, 0)


def newton_solution(spoil: float = 0.0) -> ImpactSolution:
    impulse = -np.cumsum(EXACT - three_balls.v_pre)[:-1] + np.array([spoil, 0.0])
    return solution(three_balls.v_after(impulse), impulse=impulse)


def test_a_validation_error_is_relative_to_the_fastest_body_and_names_its_reference() -> None:
    fast = chain(np.array([2.0, 0.0, 0.0]))
    (score,) = accuracy.validation(fast, np.array([0.0, 0.5, 1.5]), (reference([0.0, 0.0, 2.0]),))
    assert (score.value, score.reference, score.verdict) == (0.25, "known", Verdict.SHOWN)
    assert score.detail["distinguishable"] is True


def test_an_error_within_the_uncertainty_of_the_reference_is_not_distinguishable() -> None:
    (score,) = accuracy.validation(three_balls, EXACT + 1e-4, (reference(EXACT.tolist(), uncertainty=2e-4),))
    assert score.detail["distinguishable"] is False
    assert score.detail["uncertainty"] == 2e-4


def test_validation_reads_truths_alone_and_verification_the_law_s_own_closed_forms_alone() -> None:
    references = (reference([0.0, 0.0, 0.0]), reference(EXACT.tolist(), laws=("lcp-pgs", "gr")), count(3))
    found = solution(EXACT)
    assert [s.metric for s in accuracy.validation(three_balls, EXACT, references)] == ["validation: known"]
    assert [s.value for s in accuracy.verification(three_balls, found, references, name="gr")] == [0.0]
    assert [s.metric for s in accuracy.verification(three_balls, found, references, name="qce")] == [
        "verification: count"
    ]
    assert accuracy.verification(three_balls, found, references, name="jacobi") == ()


@pytest.mark.parametrize(
    ("error", "uncertainty", "verdict"), [(1e-10, 0.0, "pass"), (1e-8, 0.0, "fail"), (1e-8, 1e-7, "pass")]
)
def test_a_verification_error_is_gated_within_the_uncertainty_of_the_closed_form(
    error: float, uncertainty: float, verdict: str
) -> None:
    own = reference(EXACT.tolist(), uncertainty=uncertainty, laws=("gr",))
    (score,) = accuracy.verification(three_balls, solution(EXACT + error), (own,), name="gr")
    assert score.verdict.value == verdict


@given(st.integers(0, 10_000), st.integers(1, 10_000))
def test_an_iteration_count_passes_where_it_is_exact(found: int, expected: int) -> None:
    (score,) = accuracy.verification(three_balls, solution(EXACT, iterations=found), (count(expected),), name="qce")
    assert (score.verdict is Verdict.PASS) == (found == expected)


def test_the_natural_map_is_zero_for_the_exact_lcp_and_grows_with_the_error() -> None:
    solver = SOLVERS["qce"]()
    assert accuracy.newton_lcp(solver, three_balls, newton_solution()).value <= ROUNDING
    spoiled = accuracy.newton_lcp(solver, three_balls, newton_solution(1e-6))
    # W = tridiag(-1, 2, -1): the impulse's error times its largest entry, over the largest approach of 1.
    assert spoiled.value == pytest.approx(2e-6, rel=1e-6)
    assert spoiled.verdict is Verdict.FAIL
    assert spoiled.reference == "Newton LCP"


def test_the_natural_map_does_not_depend_on_units() -> None:
    scaled = ImpactProblem(three_balls.inverse_mass * 1e-12, three_balls.J, three_balls.v_pre * 1e9)
    impulse = newton_solution(1e-3).impulse
    assert impulse is not None
    target = -three_balls.u_pre
    value = accuracy.natural_map(three_balls, newton_solution(1e-3), target)
    other = accuracy.natural_map(scaled, solution(scaled.v_pre, impulse=impulse * 1e21), target * 1e9)
    assert other == pytest.approx(value, rel=1e-12)


def test_a_pulling_impulse_and_an_unanswered_approach_both_leave_a_residual() -> None:
    apart = chain(np.array([-1.0, 0.0, 1.0]))
    target = -apart.u_pre
    pulled = np.array([-1e-3, 0.0])
    assert accuracy.natural_map(apart, solution(apart.v_after(pulled), impulse=pulled), target) >= 1e-3
    idle = solution(three_balls.v_pre, impulse=np.zeros(2))
    assert accuracy.natural_map(three_balls, idle, np.zeros(2)) == 1.0


def sliding(slip: float) -> ImpactProblem:
    """A unit mass that falls on a floor with friction 0.5 and slides along it."""
    return ImpactProblem(np.ones(3), [[0.0, 0.0, 1.0]], [slip, 0.0, -1.0], 0.0, 0.5, np.eye(3)[:2])


@pytest.mark.parametrize(
    ("slip", "friction", "residual"),
    [(2.0, -0.5, 0.0), (0.3, -0.3, 0.0), (2.0, 0.0, 0.5), (0.3, 0.0, 0.3), (2.0, -0.7, 0.2)],
    ids=["slides", "sticks", "no friction while sliding", "no friction while sticking", "outside the cone"],
)
def test_the_tangent_map_is_zero_for_coulomb_friction_alone(slip: float, friction: float, residual: float) -> None:
    problem = sliding(slip)
    friction_impulse = np.array([friction, 0.0])
    impulse = np.array([1.0])
    v_post = problem.v_after(impulse, friction_impulse)
    answer = ImpactSolution(impulse, v_post, Status.CONVERGED, 1, 1, friction_impulse=friction_impulse)
    # Both are over the largest |u_pre|, which is 1.
    assert accuracy.tangent_map(problem, answer) == pytest.approx(residual, abs=ROUNDING)


# EHI takes a few large steps by design: its own error is the step's, see the test below.
SOLVED = [name for name in accuracy.OWN_EQUATIONS if name in SOLVERS and name != "ehi"]


@pytest.mark.parametrize("name", SOLVED)
def test_every_law_but_the_jacobi_control_solves_its_own_equations_on_three_balls(name: str) -> None:
    solver = SOLVERS[name]()
    score = accuracy.OWN_EQUATIONS[name](solver, three_balls, solver.solve(three_balls))
    assert score.reference
    if name == "jacobi":
        assert score.verdict is Verdict.FAIL
    else:
        assert score.verdict in (Verdict.PASS, Verdict.SHOWN)
        assert score.value <= accuracy.VERIFICATION_TOLERANCE


def test_explicit_hertz_impulses_solve_their_own_equations_to_second_order_in_the_step() -> None:
    def own_error(steps: float) -> float:
        law = SOLVERS["ehi"](steps_per_contact=steps, gap_memory=0.0)  # type: ignore[call-arg]
        return accuracy.OWN_EQUATIONS["ehi"](law, three_balls, law.solve(three_balls)).value

    # 16 times the steps: 256 times less error at order 2, 16 at order 1.
    assert own_error(64.0) > 64.0 * own_error(1024.0) > 0.0


def test_qce_s_answer_does_not_solve_the_newton_lcp_nor_the_other_way_round() -> None:
    qce = SOLVERS["qce"]()
    found = qce.solve(three_balls)
    assert accuracy.newton_lcp(qce, three_balls, found).verdict is Verdict.FAIL
    assert accuracy.qce_lcp(qce, three_balls, found).verdict is Verdict.PASS
    assert accuracy.qce_lcp(qce, three_balls, newton_solution()).verdict is Verdict.FAIL


def test_the_energy_residual_applies_to_elastic_impacts_alone() -> None:
    plastic = three_balls.replace(restitution=0.5)
    score = accuracy.energy(SOLVERS["qce"](), plastic, solution(plastic.v_pre))
    assert score.verdict is Verdict.NOT_APPLICABLE


@dataclass(frozen=True)
class Integrator:
    """Toy law whose error is its tolerance and the square of its step."""

    tolerance: float = 1e-6
    steps_per_contact: float = 10.0

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return solution(EXACT + self.tolerance + 1.0 / self.steps_per_contact**2)


def test_self_convergence_is_the_change_under_a_coarser_run() -> None:
    solver = Integrator()
    score = accuracy.self_convergence(solver, three_balls, solver.solve(three_balls))
    assert score.value == pytest.approx(99e-6 + 0.03, rel=1e-9)
    assert score.verdict is Verdict.SHOWN
