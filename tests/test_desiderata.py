"""The six desiderata on perfect answers, and on answers that are spoiled in one way each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from harness import desiderata, metamorphic
from harness.desiderata import SYMMETRY_TOLERANCE
from harness.measurement import Score, Verdict
from harness.sweeps import chain, ideal_exchange, newton_lcp_of_chain
from scenarios.scenario import Invariant, Reference, ReferenceKind, Symmetry
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Status
from solvers.solution import Floats

# A handful of sums and products of numbers near one.
ROUNDING = 1e-14

MOMENTUM = Invariant("momentum", np.ones(3))
NO_TAGS: frozenset[str] = frozenset()


def answer(problem: ImpactProblem, v_post: Floats, status: Status = Status.CONVERGED) -> ImpactSolution:
    """Wrap a velocity of a free chain as a solution, with the impulse that leads to it."""
    impulse = -np.cumsum(v_post - problem.v_pre)[:-1]
    return ImpactSolution(impulse, v_post, status, 1, problem.m)


def ideal_reference(problem: ImpactProblem) -> Reference:
    return Reference("ideal exchange", ideal_exchange(problem.v_pre), ReferenceKind.CLOSED_FORM, "Payr 2008", 0.0)


def judged(problem: ImpactProblem, solution: ImpactSolution) -> list[Score]:
    """Every desideratum that one solve of a chain can tell."""
    return [
        desiderata.brk_chain(problem, solution.v_post, ideal_reference(problem)),
        *desiderata.kin(problem, solution.v_post),
        desiderata.mom(problem, solution.v_post, (MOMENTUM,)),
        *desiderata.one(problem, solution, tags=NO_TAGS),
    ]


def failed(scores: list[Score]) -> set[str]:
    return {f"{score.name}: {score.metric}" for score in scores if score.verdict is Verdict.FAIL}


def about_center(v: Floats, factor: float) -> Floats:
    """Velocities of equal balls with their motion about the center of mass multiplied."""
    mean: float = v.mean()
    return mean + factor * (v - mean)


def drifting(v: Floats) -> Floats:
    """Velocities of equal balls with the same energy and another momentum."""
    mean = float(v.mean())
    shifted = mean + 0.05
    inner = float(((v - mean) ** 2).sum())
    factor = math.sqrt(1.0 + v.size * (mean**2 - shifted**2) / inner)
    return shifted + factor * (v - mean)


three_balls = chain(np.array([0.5, 0.0, -1.0]))
cradle = chain(np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("problem", [three_balls, cradle], ids=["three balls", "cradle"])
def test_a_perfect_answer_passes_every_desideratum(problem: ImpactProblem) -> None:
    scores = judged(problem, answer(problem, ideal_exchange(problem.v_pre)))
    assert failed(scores) == set()
    assert {s.name for s in scores if s.verdict is Verdict.PASS} >= {"KIN", "MOM", "ONE"}


SPOILS: dict[str, Callable[[ImpactSolution], ImpactSolution]] = {
    "KIN: energy gained": lambda s: replace(s, v_post=about_center(s.v_post, 1.0 + 1e-6)),
    "KIN: energy lost": lambda s: replace(s, v_post=about_center(s.v_post, 1.0 - 1e-6)),
    "MOM: worst momentum drift": lambda s: replace(s, v_post=drifting(s.v_post)),
    "ONE: pulling impulse": lambda s: replace(s, impulse=np.array([1.0, -1e-6])),
    "ONE: remaining approach": lambda s: replace(s, v_post=three_balls.v_pre),
}


@pytest.mark.parametrize("name", SPOILS)
def test_an_answer_spoiled_in_one_way_fails_exactly_that_score(name: str) -> None:
    perfect = answer(three_balls, ideal_exchange(three_balls.v_pre))
    assert failed(judged(three_balls, SPOILS[name](perfect))) == {name}


def test_no_break_away_fails_brk_alone() -> None:
    scores = judged(cradle, answer(cradle, np.array([-1.0, 2.0, 2.0]) / 3.0))
    assert failed(scores) == {"BRK: worst separation of touching contacts"}


@given(st.floats(0.0, 1.0))
def test_brk_is_the_share_of_the_ideal_separation(share: float) -> None:
    v_post = np.array([0.0, 1.0 - share, 1.0])
    score = desiderata.brk_chain(cradle, v_post, ideal_reference(cradle))
    assert abs(score.value - share) <= ROUNDING
    assert (score.verdict is Verdict.PASS) == (score.value >= desiderata.BREAK_TOLERANCE)
    assert score.reference == "ideal exchange"


def test_brk_does_not_apply_where_all_contacts_approach() -> None:
    score = desiderata.brk_chain(three_balls, three_balls.v_pre, ideal_reference(three_balls))
    assert score.verdict is Verdict.NOT_APPLICABLE
    assert math.isnan(score.value)


def test_brk_in_a_rack_counts_the_contacts_that_separate_in_the_reference_and_here() -> None:
    compliant = Reference("Hertz", np.array([-1.0, 0.0, 1.0]), ReferenceKind.ODE, "computed", 1e-9)
    both = desiderata.brk_share(cradle, np.array([-0.2, 0.0, 0.2]), compliant)
    half = desiderata.brk_share(cradle, np.array([0.0, 0.04, 1.0]), compliant)
    assert (both.value, half.value) == (1.0, 0.5)
    assert both.verdict is Verdict.SHOWN


def test_kin_gates_no_loss_where_restitution_is_below_one() -> None:
    plastic = three_balls.replace(restitution=0.5)
    scores = {score.metric: score for score in desiderata.kin(plastic, about_center(plastic.v_pre, 0.5))}
    assert scores["energy lost"].verdict is Verdict.SHOWN
    assert scores["energy lost"].value > 0.1
    assert scores["energy gained"].verdict is Verdict.PASS


def test_kin_does_not_apply_where_an_immovable_body_moves() -> None:
    racket = ImpactProblem([0.0, 1.0], [[-1.0, 1.0]], [1.0, 0.0])
    (score,) = desiderata.kin(racket, np.array([1.0, 2.0]))
    assert score.verdict is Verdict.NOT_APPLICABLE


def test_mom_is_relative_to_what_moves_when_the_total_is_zero() -> None:
    head_on = chain(np.array([1.0, 0.0, -1.0]))
    score = desiderata.mom(head_on, np.array([-1.0, 0.0, 1.0 + 2e-11]), (MOMENTUM,))
    assert abs(score.value - 1e-11) <= 1e-15
    assert score.verdict is Verdict.FAIL


def test_an_honest_iteration_limit_on_a_jammed_scene_is_not_judged_by_one() -> None:
    jammed = frozenset({"jammed"})
    open_end = answer(three_balls, three_balls.v_pre, Status.ITERATION_LIMIT)
    assert failed(list(desiderata.one(three_balls, open_end, tags=jammed))) == set()
    lying = replace(open_end, status=Status.CONVERGED)
    assert failed(list(desiderata.one(three_balls, lying, tags=jammed))) == {"ONE: remaining approach"}
    assert failed(list(desiderata.one(three_balls, open_end, tags=NO_TAGS))) == {"ONE: remaining approach"}


class InOrder:
    """Reflects the violated contacts one at a time in the order of their numbers: the negative control for SYM."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        impulse = np.zeros(problem.m)
        for _ in range(100):
            for i in range(problem.m):
                u = float((problem.J @ problem.v_after(impulse))[i])
                impulse[i] += max(0.0, -2.0 * u) / problem.W_diagonal[i]
        return ImpactSolution(impulse, problem.v_after(impulse), Status.CONVERGED, 100, 100 * problem.m)


def two_targets() -> tuple[ImpactProblem, Symmetry]:
    """Bernoulli's striker against two touching balls, in the plane, and the mirror of the scene."""
    n = np.array([[math.sqrt(0.75), 0.5], [math.sqrt(0.75), -0.5]])
    J = np.zeros((2, 6))
    J[:, :2] = -n
    J[0, 2:4], J[1, 4:6] = n
    mirror = np.kron(np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]]), np.diag([1.0, -1.0]))
    return ImpactProblem(np.ones(6), J, [1.0, 0, 0, 0, 0, 0]), Symmetry("mirror", sp.csr_array(mirror))


def test_a_law_that_works_contact_after_contact_fails_sym_and_qce_passes() -> None:
    problem, mirror = two_targets()
    orders = [(np.array([1, 0]), np.arange(6))]
    for solve, passes in ((InOrder().solve, False), (SOLVERS["qce"]().solve, True)):
        v_post = solve(problem).v_post
        mirrored = metamorphic.symmetry_residuals(solve, [mirror], problem, v_post)
        reordered = metamorphic.renumbering_residuals(solve, orders, problem, v_post)
        assert (mirrored["mirror"] <= SYMMETRY_TOLERANCE) == passes
        assert (reordered["renumbering 1"] <= SYMMETRY_TOLERANCE) == passes
        assert (desiderata.sym("worst", {**mirrored, **reordered}).verdict is Verdict.PASS) == passes


def test_sym_names_its_worst_map() -> None:
    score = desiderata.sym("worst symmetry residual", {"mirror": 1e-3, "turn": 1e-16})
    assert (score.verdict, score.detail["worst"]) == (Verdict.FAIL, "mirror")


def test_skill_is_one_for_the_truth_and_zero_for_the_newton_lcp() -> None:
    truth, newton = [np.array([0.0, 1.0])], [np.array([0.5, 0.5])]
    assert desiderata.skill(truth, newton, truth) == 1.0
    assert desiderata.skill(newton, newton, truth) == 0.0
    assert desiderata.wav_skill(0.0, sweep="cradles", reference="Hertz").verdict is Verdict.FAIL
    assert desiderata.wav_skill(0.1, sweep="cradles", reference="Hertz").verdict is Verdict.PASS


@given(st.floats(0.0, 1.0))
def test_the_newton_lcp_of_three_balls_has_its_closed_form(va: float) -> None:
    problem = chain(np.array([va, 0.0, -1.0]))
    expected = np.array([-(va + 2.0), 2.0 * (va - 1.0), 2.0 * va + 1.0]) / 3.0
    np.testing.assert_allclose(newton_lcp_of_chain(problem), expected, rtol=0, atol=ROUNDING)


@settings(max_examples=40)
@given(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=6))
def test_the_newton_lcp_of_a_chain_pushes_everywhere_and_reverses_every_contact(steps: list[float]) -> None:
    problem = chain(-np.cumsum([0.0, *steps]))
    v_post = newton_lcp_of_chain(problem)
    impulse = -np.cumsum(v_post - problem.v_pre)[:-1]
    assert impulse.min() >= -ROUNDING
    np.testing.assert_allclose(problem.J @ v_post, -problem.u_pre, rtol=0, atol=ROUNDING)
