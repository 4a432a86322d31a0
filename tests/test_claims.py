"""The paper's claims: every verdict follows from the rows, whatever they say, and none from missing ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.optimize import brentq

from harness.claims import CLAIMS, PAPER_TABLE_1, SOLVER_OF, ClaimVerdict, Evidence, check_claims, compare_sweeps
from harness.measurement import DESIDERATA
from harness.results import Results, ResultsError, ThreeBallSweep, three_ball_sweep
from solvers.solution import Floats
from tests.handmade_rows import VA, HandmadeStore, add_disturbed, add_sweep, gr_law, ideal_law, lcp_law, qce_law

CONFIRMED, PARTLY, REFUTED, NOT_MEASURED = (
    ClaimVerdict.CONFIRMED, ClaimVerdict.PARTLY, ClaimVerdict.REFUTED, ClaimVerdict.NOT_MEASURED,
)  # fmt: skip


def findings(store: HandmadeStore) -> Mapping[str, Evidence]:
    return {finding.claim.key: finding.evidence for finding in check_claims(Results(store))}


def with_sweeps(**laws: Floats) -> HandmadeStore:
    store = HandmadeStore()
    for solver, v_post in laws.items():
        add_sweep(store, solver.replace("_", "-"), v_post)
    return store


def test_every_claim_is_not_measured_where_there_are_no_rows() -> None:
    store = HandmadeStore()
    store.task("qce", "bernoulli", outcome=None)
    found = findings(store)
    assert {key: evidence.verdict for key, evidence in found.items()} == dict.fromkeys(found, NOT_MEASURED)
    assert not any(evidence.rows for evidence in found.values())


def test_every_claim_has_a_key_of_its_own_and_says_where_it_stands() -> None:
    assert len({claim.key for claim in CLAIMS}) == len(CLAIMS)
    assert all(claim.where and claim.statement and claim.source for claim in CLAIMS)


def test_table_1_has_18_claims_and_is_confirmed_by_rows_that_agree() -> None:
    store = HandmadeStore()
    for law, solver in SOLVER_OF.items():
        store.all_six(solver, failing=[name for name in DESIDERATA if not PAPER_TABLE_1[law][name]])
    cells = {key: evidence for key, evidence in findings(store).items() if key.startswith("table-1:")}
    assert len(cells) == 18
    assert {evidence.verdict for evidence in cells.values()} == {CONFIRMED}


def test_table_1_is_refuted_cell_by_cell_by_rows_that_do_not_agree() -> None:
    store = HandmadeStore()
    for law, solver in SOLVER_OF.items():
        store.all_six(solver, failing=[name for name in DESIDERATA if PAPER_TABLE_1[law][name]])
    cells = {key: evidence for key, evidence in findings(store).items() if key.startswith("table-1:")}
    assert {evidence.verdict for evidence in cells.values()} == {REFUTED}


def test_a_lost_task_is_no_proof_of_a_cross_and_no_full_dot() -> None:
    store = HandmadeStore()
    store.all_six("gr")
    store.task("gr", "ball-ring", outcome="timed out")
    found = findings(store)
    assert found["table-1:GR:WAV"].verdict is NOT_MEASURED
    assert found["table-1:GR:KIN"].verdict is PARTLY
    assert "1 tasks lost (timed out)" in found["table-1:GR:KIN"].summary


def test_qce_is_more_accurate_on_average_only_and_the_crossing_is_that_of_the_closed_forms() -> None:
    # Ideal reference, independent of the code: the va at which both laws are equally far away.
    def excess(va: float) -> float:
        at = np.array([va])
        ours, theirs = (np.linalg.norm(law(at) - ideal_law(at)) for law in (qce_law, lcp_law))
        return float(ours - theirs)

    crossing = float(brentq(excess, 0.3, 0.9))
    evidence = findings(with_sweeps(qce=qce_law(VA), gr=gr_law(VA), lcp_pgs=lcp_law(VA)))["accuracy-over-va"]
    assert evidence.verdict is PARTLY
    # The curves bend by less than this within one step of the sweep.
    assert evidence.numbers["worse than lcp-pgs from va (to ideal)"] == pytest.approx(crossing, abs=2e-3)
    assert evidence.numbers["worse than gr from va (to ideal)"] == pytest.approx(crossing, abs=2e-3)
    assert crossing == pytest.approx(0.64, abs=0.005)
    assert len(evidence.rows) == 3


def test_accuracy_is_confirmed_by_a_law_that_is_closer_everywhere_and_refuted_by_one_that_is_not() -> None:
    better = with_sweeps(qce=ideal_law(VA), lcp_pgs=lcp_law(VA))
    assert findings(better)["accuracy-over-va"].verdict is CONFIRMED
    worse = with_sweeps(qce=lcp_law(VA), lcp_pgs=ideal_law(VA))
    evidence = findings(worse)["accuracy-over-va"]
    assert evidence.verdict is REFUTED
    assert evidence.numbers["worse than lcp-pgs from va (to ideal)"] == pytest.approx(VA[1])


def test_a_comparison_uses_only_values_with_a_reference() -> None:
    hertz = ideal_law(VA)
    hertz[:] = np.nan
    store = HandmadeStore()
    add_sweep(store, "qce", qce_law(VA), hertz=hertz)
    add_sweep(store, "gr", gr_law(VA), hertz=hertz)
    results = Results(store)
    law, rival = three_ball_sweep(results, "qce"), three_ball_sweep(results, "gr")
    assert isinstance(law, ThreeBallSweep)
    assert isinstance(rival, ThreeBallSweep)
    assert compare_sweeps(law, rival, name="gr", reference="hertz") is None
    assert compare_sweeps(law, rival, name="gr", reference="ideal") is not None
    assert "Hertz" not in findings(store)["accuracy-over-va"].summary


def test_qce_follows_theory_if_it_does_and_not_as_published() -> None:
    assert findings(with_sweeps(qce=qce_law(VA)))["follows-theory"].verdict is REFUTED
    assert findings(with_sweeps(qce=ideal_law(VA)))["follows-theory"].verdict is CONFIRMED


def test_qce_is_exact_at_both_ends_or_at_one() -> None:
    assert findings(with_sweeps(qce=qce_law(VA)))["exact-at-ends"].verdict is CONFIRMED
    assert findings(with_sweeps(qce=lcp_law(VA)))["exact-at-ends"].verdict is PARTLY
    assert findings(with_sweeps(qce=lcp_law(VA) + 0.1))["exact-at-ends"].verdict is REFUTED


def test_gr_is_the_lcp_but_at_zero() -> None:
    assert findings(with_sweeps(gr=gr_law(VA), lcp_pgs=lcp_law(VA)))["gr-is-lcp"].verdict is CONFIRMED
    assert findings(with_sweeps(gr=lcp_law(VA), lcp_pgs=lcp_law(VA)))["gr-is-lcp"].verdict is PARTLY
    assert findings(with_sweeps(gr=qce_law(VA), lcp_pgs=lcp_law(VA)))["gr-is-lcp"].verdict is REFUTED


def test_the_two_references_are_compared_with_each_other() -> None:
    store = with_sweeps(qce=qce_law(VA))
    assert findings(store)["ideal-is-hertz"].verdict is CONFIRMED
    store = HandmadeStore()
    add_sweep(store, "qce", qce_law(VA), hertz=ideal_law(VA) + 0.06)
    evidence = findings(store)["ideal-is-hertz"]
    assert evidence.verdict is REFUTED
    assert evidence.numbers["largest distance"] == pytest.approx(0.06 * np.sqrt(3.0))


@pytest.mark.parametrize(
    ("jump", "verdict"),
    [({3: 0.0, 4: 0.0}, CONFIRMED), ({3: 0.0, 4: 0.3}, PARTLY), ({4: 0.3, 5: 0.2}, REFUTED)],
)
def test_robustness_is_a_response_in_proportion_to_the_disturbance(
    jump: Mapping[int, float], verdict: ClaimVerdict
) -> None:
    store = HandmadeStore()
    add_disturbed(store, "qce", jump=jump)
    evidence = findings(store)["robust"]
    assert evidence.verdict is verdict
    assert evidence.numbers["4 balls"] == pytest.approx(jump[4] or 1e-8)


def test_the_jump_of_gr_is_confirmed_by_a_jump_only() -> None:
    for leap, verdict in ((0.5, CONFIRMED), (0.0, REFUTED)):
        store = HandmadeStore()
        add_disturbed(store, "gr", jump={3: leap})
        assert findings(store)["gr-jumps"].verdict is verdict


def test_the_closer_law_under_disturbance_is_told_from_the_farther_one() -> None:
    for ours, theirs, verdict in ((0.0, 0.5, CONFIRMED), (0.5, 0.0, REFUTED), (0.1, 0.1, REFUTED)):
        store = HandmadeStore()
        add_disturbed(store, "qce", jump={3: ours})
        add_disturbed(store, "gr", jump={3: theirs})
        assert findings(store)["closer-when-disturbed"].verdict is verdict


@pytest.mark.parametrize(("error", "verdict"), [(1e-15, CONFIRMED), (1e-3, REFUTED)])
def test_the_mean_energy_error_is_compared_with_the_printed_one(error: float, verdict: ClaimVerdict) -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    row = store.score(task, "KIN", error, metric="energy error e", verdict="shown")
    evidence = findings(store)["energy-error"]
    assert (evidence.verdict, evidence.rows) == (verdict, (f"score {row}",))
    assert evidence.numbers["mean"] == error


def test_a_contact_entered_twice_must_change_nothing() -> None:
    for change, verdict in ((1e-15, CONFIRMED), (0.01, REFUTED)):
        store = HandmadeStore()
        task = store.all_six("qce")
        store.score(task, "invariance", change, metric="contact entered twice", verdict="shown")
        assert findings(store)["sampling"].verdict is verdict


def test_termination_counts_the_scenes_and_names_those_that_did_not_end() -> None:
    store = HandmadeStore()
    store.task("qce", "bernoulli", iterations=4)
    assert findings(store)["terminates"].verdict is CONFIRMED
    stuck = store.task("qce", "ball-between-walls", status="iteration limit", iterations=10_000)
    store.task("qce", "box-on-floor", outcome="refused")
    evidence = findings(store)["terminates"]
    assert (evidence.verdict, evidence.rows) == (PARTLY, (f"task {stuck}",))
    assert "1 of 2 scenes" in evidence.summary
    assert "iteration limit" in evidence.summary


def outcome(store: HandmadeStore, solver: str, scenario: str, v_post: list[float], *, restitution: float) -> int:
    """A single impact with its velocities stored."""
    task = store.task(solver, scenario, parameters={"restitution": restitution})
    return store.series(task, "solution", {"v_pre": [1.0, 0.0], "v_post": v_post, "impulse": [1.0]})


@pytest.mark.parametrize(("v_b", "verdict"), [(0.7, CONFIRMED), (0.8, REFUTED)])
def test_the_blend_is_compared_with_qce_lcp_where_they_may_differ(v_b: float, verdict: ClaimVerdict) -> None:
    store = HandmadeStore()
    outcome(store, "qce-lcp", "elastic", [0.0, 1.0], restitution=1.0)
    outcome(store, "qce-blend", "elastic", [0.0, 1.0], restitution=1.0)
    assert findings(store)["blend"].verdict is NOT_MEASURED
    exact = outcome(store, "qce-lcp", "half", [0.3, 0.7], restitution=0.4)
    blend = outcome(store, "qce-blend", "half", [0.3, v_b], restitution=0.4)
    evidence = findings(store)["blend"]
    assert (evidence.verdict, evidence.rows) == (verdict, (f"series {blend}", f"series {exact}"))
    assert evidence.numbers["largest difference"] == pytest.approx(v_b - 0.7)


def test_qce_lcp_must_be_qce_where_the_impact_is_elastic() -> None:
    for v_b, verdict in ((1.0, CONFIRMED), (0.9, REFUTED)):
        store = HandmadeStore()
        outcome(store, "qce", "elastic", [0.0, 1.0], restitution=1.0)
        outcome(store, "qce-lcp", "elastic", [0.0, v_b], restitution=1.0)
        assert findings(store)["elastic-limit"].verdict is verdict


def test_the_energy_bound_of_qce_lcp_is_broken_by_one_gain() -> None:
    store = HandmadeStore()
    task = store.task("qce-lcp", "bernoulli")
    store.score(task, "KIN", 0.0, metric="energy gained")
    assert findings(store)["bounded"].verdict is CONFIRMED
    store.score(task, "KIN", 1e-3, metric="energy gained")
    assert findings(store)["bounded"].verdict is REFUTED


def test_the_cradle_of_qce_is_compared_with_the_ideal_exchange() -> None:
    evidence = findings(with_sweeps(qce=qce_law(VA)))["cradle-exchange"]
    assert evidence.verdict is CONFIRMED
    assert evidence.numbers["hertz to ideal"] == pytest.approx(0.01)


def test_a_series_of_the_wrong_shape_is_an_error_that_names_it() -> None:
    store = HandmadeStore()
    task = store.task("qce", "wave", kind="sweep")
    row = store.series(task, "three-ball sweep", {"va": [0.0, 1.0], "v_post": [[1.0, 2.0, 3.0]]})
    with pytest.raises(ResultsError, match=rf"series {row} .*'v_post'"):
        findings(store)
