"""The contract check, the claims, and what a whole task measures on hand-made scenes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from harness import measure, robustness
from harness.checked import checked_solve, claim, termination
from harness.measure import FULL, MINIMAL, ONCE, REDUCED, SCANT, Effort, effort_for, measure_impact, measure_sweep
from harness.measurement import DESIDERATA, InvalidSolution, Measurement, Verdict
from harness.sweeps import chain, disturbance, ideal_exchange, newton_lcp_of_chain, wave
from scenarios.scenario import Invariant, Reference, ReferenceKind, Scenario, Symmetry
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Solver, Status, UnsupportedProblem

three_balls = chain(np.array([1.0, 0.0, -1.0]))
cradle = chain(np.array([1.0, 0.0, 0.0, 0.0]))


def free_chain(problem: ImpactProblem, *, tags: frozenset[str] = frozenset({"chain"})) -> Scenario:
    """A scene of equal balls with the ideal exchange as its reference."""

    def ideal() -> Reference:
        value = ideal_exchange(problem.v_pre)
        return Reference("ideal exchange", value, ReferenceKind.CLOSED_FORM, "Payr 2008", 0.0)

    mirror = Symmetry("mirror", sp.csr_array(-np.eye(problem.n)[::-1]))
    momentum = Invariant("momentum", np.ones(problem.n))
    return Scenario("chain", {"n": problem.n}, problem, "by hand", (ideal,), (mirror,), (momentum,), tags)


@dataclass(frozen=True)
class Spoiled:
    """QCE with its answer changed."""

    spoil: Callable[[ImpactProblem, ImpactSolution], ImpactSolution]

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        return self.spoil(problem, SOLVERS["qce"]().solve(problem))


@dataclass(frozen=True)
class NewtonOfChains:
    """The Newton LCP by its linear system: exact while nothing separates."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        v_post = newton_lcp_of_chain(problem)
        return ImpactSolution(None, v_post, Status.CONVERGED, 1, problem.m)


def verdicts(measurement: Measurement) -> dict[str, Verdict]:
    return {f"{score.name}: {score.metric}": score.verdict for score in measurement.scores}


def failures(measurement: Measurement) -> set[str]:
    return {name for name, verdict in verdicts(measurement).items() if verdict is Verdict.FAIL}


# The contract ---------------------------------------------------------------------------------------------------------


def changed(**fields: Any) -> Callable[[ImpactSolution], Any]:
    """Make a spoil that replaces fields of a solution, by values of any type."""
    return lambda solution: replace(solution, **fields)


BROKEN: dict[str, tuple[Callable[[ImpactSolution], Any], str]] = {
    "no solution": (lambda solution: solution.v_post, "must return an ImpactSolution, not ndarray"),
    "a list": (changed(v_post=[0.0, 0.0, 0.0]), "v_post must be a NumPy array, not list"),
    "wrong shape": (changed(v_post=np.zeros(2)), r"v_post must have shape \(3,\), not \(2,\)"),
    "complex": (changed(v_post=np.zeros(3, np.complex128)), "v_post must hold real numbers"),
    "NaN": (changed(v_post=np.full(3, np.nan)), "v_post must be finite: entry 0 is nan"),
    "infinite": (changed(impulse=np.array([0.0, np.inf])), "impulse must be finite: entry 1 is inf"),
    "short impulse": (changed(impulse=np.zeros(1)), r"impulse must have shape \(2,\)"),
    "friction": (changed(friction_impulse=np.zeros(2)), r"friction_impulse must have shape \(4,\)"),
    "status": (changed(status="converged"), "status must be a Status"),
    "fraction": (changed(iterations=1.5), "iterations must be an integer"),
    "truth value": (changed(iterations=True), "iterations must be an integer"),
    "negative": (changed(visits=-1), "visits must be ≥ 0"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_answer_that_breaks_the_contract_is_invalid_and_says_how(name: str) -> None:
    spoil, message = BROKEN[name]
    law = Spoiled(lambda problem, solution: spoil(solution))
    with pytest.raises(InvalidSolution, match=message):
        checked_solve(law, three_balls)


def test_a_sound_answer_passes_the_check_unchanged_and_without_impulse_too() -> None:
    solution = SOLVERS["qce"]().solve(three_balls)
    law = Spoiled(lambda problem, found: replace(found, impulse=None, iterations=int(np.int64(3))))
    np.testing.assert_array_equal(checked_solve(SOLVERS["qce"](), three_balls).v_post, solution.v_post)
    assert checked_solve(law, three_balls).impulse is None


def test_a_refusal_and_any_other_exception_pass_through() -> None:
    with pytest.raises(UnsupportedProblem):
        checked_solve(SOLVERS["qce"](), three_balls.replace(restitution=0.5))

    class Raises:
        def solve(self, problem: ImpactProblem) -> ImpactSolution:
            raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        checked_solve(Raises(), three_balls)


# Claims ---------------------------------------------------------------------------------------------------------------


def claimed(solution: ImpactSolution, problem: ImpactProblem = three_balls) -> dict[str, Verdict]:
    return {score.metric: score.verdict for score in claim(problem, solution)}


def test_an_honest_answer_passes_both_claims() -> None:
    assert set(claimed(SOLVERS["qce"]().solve(three_balls)).values()) == {Verdict.PASS}


def test_a_velocity_that_the_impulse_does_not_give_fails_its_claim_alone() -> None:
    solution = SOLVERS["qce"]().solve(three_balls)
    found = claimed(replace(solution, v_post=solution.v_post + np.array([-1e-9, 0.0, 1e-9])))
    assert found == {"velocity from impulse": Verdict.FAIL, "converged but not feasible": Verdict.PASS}


def test_saying_converged_of_an_answer_that_still_approaches_is_a_lie_and_the_truth_is_not() -> None:
    idle = ImpactSolution(np.zeros(2), three_balls.v_pre, Status.CONVERGED, 0, 0)
    assert claimed(idle)["converged but not feasible"] is Verdict.FAIL
    honest = replace(idle, status=Status.ITERATION_LIMIT)
    assert claimed(honest)["converged but not feasible"] is Verdict.NOT_APPLICABLE


def test_an_approach_that_newton_s_law_leaves_to_a_separating_contact_is_no_lie() -> None:
    # The right contact separates at 0.1 before, and approaches at 0.1 after: u_post = -c_r u_pre.
    problem = chain(np.array([1.0, 0.0, 0.1]))
    v_post = newton_lcp_of_chain(problem)
    impulse = -np.cumsum(v_post - problem.v_pre)[:-1]
    assert impulse.min() > 0
    solution = ImpactSolution(impulse, v_post, Status.CONVERGED, 1, 2)
    assert claimed(solution, problem)["converged but not feasible"] is Verdict.PASS
    lower = problem.replace(restitution=0.5)
    assert claimed(solution, lower)["converged but not feasible"] is Verdict.FAIL


def test_saying_converged_of_friction_outside_its_cone_is_a_lie() -> None:
    problem = ImpactProblem(np.ones(3), [[0.0, 0.0, 1.0]], [2.0, 0.0, -1.0], 0.0, 0.5, np.eye(3)[:2])
    for friction, verdict in ((-0.5, Verdict.PASS), (-0.6, Verdict.FAIL)):
        impulse, friction_impulse = np.array([1.0]), np.array([friction, 0.0])
        v_post = problem.v_after(impulse, friction_impulse)
        answer = ImpactSolution(impulse, v_post, Status.CONVERGED, 1, 1, friction_impulse=friction_impulse)
        assert claimed(answer, problem)["converged but not feasible"] is verdict


def test_a_velocity_claim_is_relative_to_what_is_summed() -> None:
    # A light ball between two heavy ones: impulses of 1e12 cancel, their rounding is no lie.
    heavy = ImpactProblem([1e-12, 1.0, 1e-12], [[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]], [1.0, 0.0, 0.0])
    impulse = np.array([1e12, 1e12])
    v_post = heavy.v_after(impulse)
    rounded = ImpactSolution(impulse, v_post + np.array([0.0, 1e-4, 0.0]), Status.CONVERGED, 1, 1)
    assert claimed(rounded, heavy)["velocity from impulse"] is Verdict.PASS
    wrong = replace(rounded, v_post=v_post + np.array([0.0, 10.0, 0.0]))
    assert claimed(wrong, heavy)["velocity from impulse"] is Verdict.FAIL


def test_termination_is_gated_but_on_jammed_scenes() -> None:
    limit = ImpactSolution(np.zeros(2), three_balls.v_pre, Status.ITERATION_LIMIT, 7, 14)
    missed, iterations, visits = termination(limit, tags=frozenset())
    assert (missed.verdict, iterations.value, visits.value) == (Verdict.FAIL, 7.0, 14.0)
    assert termination(limit, tags=frozenset({"jammed"}))[0].verdict is Verdict.SHOWN
    assert termination(replace(limit, status=Status.CONVERGED), tags=frozenset())[0].verdict is Verdict.PASS


# A whole task ---------------------------------------------------------------------------------------------------------


def test_qce_on_the_cradle_passes_all_that_is_gated_and_every_score_is_named() -> None:
    found = measure_impact(SOLVERS["qce"](), free_chain(cradle), seed=0)
    assert failures(found) == set()
    assert found.status == "converged"
    names = {score.name for score in found.scores}
    assert names == {*DESIDERATA, "invariance", "robustness", "termination", "scale", "claim", "error"} - {"WAV"}
    assert all(score.reference for score in found.scores if score.name == "error")
    assert {series.name for series in found.series} == {"solution", "responses"}


def test_a_measurement_is_the_same_for_the_same_seed_and_can_be_stored_as_json() -> None:
    first, second = (measure_impact(SOLVERS["qce"](), free_chain(cradle), seed=3) for _ in range(2))
    assert repr(first) == repr(second)
    other = measure_impact(SOLVERS["qce"](), free_chain(cradle), seed=4)
    assert repr(first) != repr(other)
    for score in first.scores:
        json.dumps(dict(score.detail))
    for series in first.series:
        json.dumps(dict(series.columns))


def test_a_solver_without_break_away_fails_brk_and_loses_no_other_desideratum() -> None:
    found = verdicts(measure_impact(SOLVERS["lcp-pgs"](), free_chain(cradle), seed=0))
    assert found["BRK: worst separation of touching contacts"] is Verdict.FAIL
    assert {name for name, verdict in found.items() if verdict is Verdict.FAIL and name[:3] in DESIDERATA} == {
        "BRK: worst separation of touching contacts"
    }


def test_an_iterate_of_a_jammed_scene_is_no_outcome_but_an_outcome_is_judged() -> None:
    jammed = free_chain(cradle, tags=frozenset({"jammed"}))

    def halved(status: Status) -> Measurement:
        spoiled = Spoiled(lambda problem, s: replace(s, v_post=0.5 * s.v_post, impulse=None, status=status))
        return measure_impact(spoiled, jammed, seed=0)

    assert verdicts(halved(Status.CONVERGED))["KIN: energy lost"] is Verdict.FAIL
    assert verdicts(halved(Status.ITERATION_LIMIT))["KIN: energy lost"] is Verdict.SHOWN
    assert verdicts(halved(Status.ITERATION_LIMIT))["SYM: worst symmetry residual"] is Verdict.SHOWN
    assert verdicts(halved(Status.ITERATION_LIMIT))["MOM: worst momentum drift"] is Verdict.FAIL


def test_a_refusal_of_the_scene_itself_propagates() -> None:
    with pytest.raises(UnsupportedProblem):
        measure_impact(SOLVERS["qce"](), free_chain(cradle.replace(restitution=0.5)), seed=0)


def _three_contacts_only(problem: ImpactProblem) -> None:
    if problem.m != 3:
        raise UnsupportedProblem("three contacts only")


class ThreeContacts:
    """QCE that refuses any other number of contacts."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        _three_contacts_only(problem)
        return SOLVERS["qce"]().solve(problem)


def test_a_refused_variant_does_not_apply_and_says_why() -> None:
    found = measure_impact(ThreeContacts(), free_chain(cradle), seed=0)
    (twice,) = (score for score in found.scores if score.metric == "contact entered twice")
    assert twice.verdict is Verdict.NOT_APPLICABLE
    assert "three contacts only" in str(twice.detail["reason"])
    assert failures(found) == set()


def test_an_invalid_answer_on_a_variant_fails_that_score_alone() -> None:
    spoiled = Spoiled(lambda problem, s: replace(s, v_post=s.v_post * np.nan) if problem.n == 5 else s)
    assert failures(measure_impact(spoiled, free_chain(cradle), seed=0)) == {"invariance: body added"}


def test_variants_that_do_not_converge_are_counted_beside_the_score() -> None:
    capped = Spoiled(lambda problem, s: replace(s, status=Status.STALLED) if problem.n == 5 else s)
    found = measure_impact(capped, free_chain(cradle), seed=0)
    (added,) = (score for score in found.scores if score.metric == "body added")
    assert added.detail["variants not converged"] == {"stalled": 1}


def test_a_scene_without_contacts_or_without_motion_is_measured_too() -> None:
    for problem in (chain(np.array([1.0])), chain(np.zeros(3))):
        scene = free_chain(problem)
        assert failures(measure_impact(SOLVERS["qce"](), scene, seed=0)) == set()


class Counting:
    """QCE that counts its solves."""

    def __init__(self) -> None:
        self.solves = 0

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        self.solves += 1
        return SOLVERS["qce"]().solve(problem)


@pytest.mark.parametrize(("balls", "bound"), [(5, 260), (100, 100), (700, 20)])
def test_the_number_of_solves_is_bounded_by_the_size_of_the_scene(balls: int, bound: int) -> None:
    counting = Counting()
    speeds = np.zeros(balls)
    speeds[0] = 1.0
    measure_impact(counting, free_chain(chain(speeds)), seed=0)
    assert 5 < counting.solves <= bound


@pytest.mark.parametrize(
    ("contacts", "visits", "iterations", "status", "effort"),
    [
        (4, 100, 1, Status.CONVERGED, FULL),
        (61, 100, 1, Status.CONVERGED, REDUCED),
        (501, 100, 1, Status.CONVERGED, MINIMAL),
        (4, measure.CHEAP, 1, Status.CONVERGED, REDUCED),
        (4, measure.DEAR, 1, Status.CONVERGED, MINIMAL),
        (4, measure.DEAREST, 1, Status.CONVERGED, SCANT),
        (4, 0, 5_000, Status.CONVERGED, SCANT),
        (4, measure.ENOUGH, 1, Status.CONVERGED, ONCE),
        (4, 0, 5_000, Status.ITERATION_LIMIT, ONCE),
        (4, 0, 10_000, Status.ITERATION_LIMIT, ONCE),
        (4, 100, 1, Status.STALLED, FULL),
    ],
)
def test_a_dear_solve_lowers_the_effort_whatever_the_size(
    contacts: int, visits: int, iterations: int, status: Status, effort: Effort
) -> None:
    solution = ImpactSolution(None, np.zeros(1), status, iterations, visits)
    assert effort_for(contacts=contacts, solution=solution) is effort


def test_a_dear_solve_that_was_cut_off_is_repeated_for_symmetry_alone() -> None:
    counting = Counting()
    cut_off = Spoiled(
        lambda problem, s: replace(counting.solve(problem), visits=measure.DEAREST + 1, status=Status.ITERATION_LIMIT)
    )
    scores = {score.metric: score for score in measure_impact(cut_off, free_chain(cradle), seed=0).scores}
    assert counting.solves == 3
    assert scores["worst renumbering residual"].verdict is Verdict.PASS
    for metric in ("mirror", "speed scaled", "largest response", "jump"):
        assert scores[metric].verdict is Verdict.NOT_APPLICABLE


def test_what_was_not_tried_says_so() -> None:
    dear = Spoiled(lambda problem, s: replace(s, visits=measure.DEAREST + 1))
    scores = {score.metric: score for score in measure_impact(dear, free_chain(cradle), seed=0).scores}
    for metric in ("contact entered twice", "jump"):
        assert scores[metric].verdict is Verdict.NOT_APPLICABLE
        assert "not tried" in str(scores[metric].detail["reason"])


def test_large_scenes_store_no_solution() -> None:
    speeds = np.zeros(201)
    speeds[0] = 1.0
    found = measure_impact(SOLVERS["qce"](), free_chain(chain(speeds)), seed=0)
    assert "solution" not in {series.name for series in found.series}


# Sweeps ---------------------------------------------------------------------------------------------------------------

pytest.importorskip("solvers.hertz")


def test_the_wave_sweep_passes_qce_and_fails_the_newton_lcp_in_every_score() -> None:
    qce = wave(SOLVERS["qce"](), seed=0, values=5)
    assert failures(qce) == set()
    newton = wave(NewtonOfChains(), seed=0, values=5)
    assert all(score.verdict is Verdict.FAIL for score in newton.scores)
    assert {score.reference for score in newton.scores} == {"", "ideal exchange", "Hertz"}


def test_the_wave_sweep_stores_its_curves() -> None:
    found = wave(SOLVERS["qce"](), seed=0, values=5)
    bounce, cradles = found.series
    assert bounce.columns["va"] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert np.asarray(bounce.columns["hertz"]).shape == (5, 3)
    # physics.md: Hertz at va = 0.5, and QCE's closed form.
    rows = {name: np.asarray(bounce.columns[name])[2] for name in ("v_post", "ideal", "hertz", "lcp")}
    np.testing.assert_allclose(rows["hertz"], [-0.999242, -0.002267, 0.501508], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows["v_post"], [-1.045820, 0.212486, 1 / 3], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(rows["ideal"], [-1.0, 0.0, 0.5])
    np.testing.assert_allclose(rows["lcp"], [-2.5 / 3, -1 / 3, 2 / 3], rtol=0, atol=1e-12)
    assert len(list(np.asarray(cradles.columns["balls"]))) == 2 + 3 + 4 + 5 + 6


def test_locality_sees_the_slope_of_the_ideal_exchange_and_none_in_the_newton_lcp() -> None:
    class Ideal:
        def solve(self, problem: ImpactProblem) -> ImpactSolution:
            return ImpactSolution(None, np.sort(problem.v_pre), Status.CONVERGED, 1, 1)

    for law, slope in ((Ideal(), 1.0), (NewtonOfChains(), 0.0)):
        score = wave(law, seed=0, values=2).scores[0]
        assert score.value == pytest.approx(slope, abs=1e-9)


def test_the_disturbance_sweep_tells_a_law_that_jumps_from_one_that_does_not() -> None:
    def largest(solver: Solver) -> float:
        found = measure_sweep(solver, "disturbance", {"draws": 60, "sizes": [1e-8], "balls": [4]}, seed=0)
        (series,) = found.series
        assert np.asarray(series.columns["v_post"]).shape == (60, 4)
        assert series.columns["balls"] == 4
        return found.scores[0].value

    # A jump is a million times the disturbance; its size depends on the direction.
    assert largest(SOLVERS["qce"]()) > 0.01
    assert largest(SOLVERS["qce-defer"]()) < 1e-6


def test_a_sweep_reports_solves_that_did_not_converge() -> None:
    capped = Spoiled(lambda problem, s: replace(s, status=Status.STALLED))
    found = disturbance(capped, seed=0, balls=(3,), sizes=(1e-4,), draws=2)
    assert found.status == "stalled"


def test_the_refused_sweep_propagates() -> None:
    class Refuses:
        def solve(self, problem: ImpactProblem) -> ImpactSolution:
            raise UnsupportedProblem("never")

    with pytest.raises(UnsupportedProblem):
        measure_sweep(Refuses(), "wave", {}, seed=0)


def test_the_probe_is_among_the_sizes_of_the_full_effort() -> None:
    assert robustness.PROBE in FULL.sizes
    assert all(math.isfinite(size) and size > 0 for size in FULL.sizes)
