"""The regression gate: signed changes on a logarithm, what fails, what is written, and every kind of bad input."""

from __future__ import annotations

import io
import json
import math
import os
import re
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import impactbench
from harness import baseline as gate
from harness.baseline import Baseline, BaselineError, Change, Comparison, Entry, collect, compare, signed_change
from harness.environment import describe_environment
from harness.measurement import Kind, Task
from harness.revision import RevisionError, TimeComparison, TimeRatio, quartiles
from harness.run import plan_tasks
from harness.selection import choose_solver
from harness.store import FILE_NAME, PlannedTask
from harness.sweeps import SWEEPS
from reports.gate import gate_markdown, render_gate, render_times
from scenarios.tiers import TIERS
from tests.handmade_rows import HandmadeStore

if TYPE_CHECKING:
    from harness.pytest_plugin import ImpactGate

pytest_plugins = ["harness.pytest_plugin"]

ROOT = Path(__file__).parent.parent
# One digit of a signed change that is written with three.
DIGIT = 1e-3
EPS = 2.220446049250313e-16
SCENE = "bernoulli()"
PAIR = ("qce", SCENE)
HERE: Mapping[str, object] = {"impactbench": "0.1.0", "cpu": "a_cpu", "commit": "0123abc", "numpy": "2.0"}


def entry(**values: float) -> Entry:
    """What was measured on a scene of three contacts; underscores stand for blanks."""
    return Entry("measured", 3, {name.replace("_", " "): float(value) for name, value in values.items()})


def baseline(*, solvers: tuple[str, ...] | None = None, **entries: Entry) -> Baseline:
    """A baseline of solvers on one scene."""
    return Baseline("smoke", 0, solvers, HERE, {(name.replace("_", "-"), SCENE): e for name, e in entries.items()})


def only(accepted: Entry, now: Entry | None) -> gate.Difference:
    """The one difference between two entries of one number."""
    found = compare(baseline(qce=accepted), {} if now is None else {PAIR: now}, environment=HERE).differences
    assert len(found) == 1
    return found[0]


# The comparison.


def test_an_error_that_grows_from_2e_9_to_1e_8_fails() -> None:
    # numpy.isclose(1e-8, 2e-9) is true: its absolute tolerance of 1e-8 would let it pass.
    difference = only(entry(energy_lost=2e-9), entry(energy_lost=1e-8))
    assert difference.change == pytest.approx(math.log10(5), abs=1e-12)
    assert difference.verdict is Change.WORSE


def test_an_error_that_shrinks_never_fails() -> None:
    difference = only(entry(energy_lost=1e-8), entry(energy_lost=2e-9))
    assert difference.change == pytest.approx(-math.log10(5), abs=1e-12)
    assert difference.verdict is Change.BETTER


@pytest.mark.parametrize(("factor", "verdict"), [(3.0, Change.SAME), (3.3, Change.WORSE), (0.3, Change.BETTER)])
def test_the_allowance_is_half_a_decade_on_either_side(factor: float, verdict: Change) -> None:
    assert only(entry(energy_gained=1e-10), entry(energy_gained=factor * 1e-10)).verdict is verdict


def test_what_is_below_eight_eps_a_contact_is_rounding() -> None:
    floor = 8 * EPS * 3
    assert gate.rounding_floor(3) == floor
    assert only(entry(energy_lost=0.0), entry(energy_lost=floor)).change == 0.0
    assert only(entry(energy_lost=1e-300), entry(energy_lost=0.99 * floor)).change == 0.0
    # What rises above the floor is measured from the floor, not from zero.
    risen = only(entry(energy_lost=0.0), entry(energy_lost=10 * floor))
    assert risen.change == pytest.approx(1.0, abs=1e-12)
    assert risen.verdict is Change.WORSE


@pytest.mark.parametrize(
    ("accepted", "now", "verdict"),
    [
        (1e-15, 9e-10, Change.SAME), (1e-15, 3e-9, Change.SAME), (1e-15, 4e-9, Change.WORSE), (0.1, 0.4, Change.WORSE),
        (1.1, 1e-12, Change.BETTER),
    ],
)  # fmt: skip
def test_symmetry_counts_from_its_own_bound_on(accepted: float, now: float, verdict: Change) -> None:
    assert only(entry(symmetry_residual=accepted), entry(symmetry_residual=now)).verdict is verdict
    assert only(entry(renumbering_residual=accepted), entry(renumbering_residual=now)).verdict is verdict


def test_a_scene_without_contacts_has_the_floor_of_one() -> None:
    assert gate.rounding_floor(0) == 8 * EPS


@pytest.mark.parametrize(
    ("accepted", "now", "verdict"),
    [
        (100, 119, Change.SAME), (100, 121, Change.WORSE), (100, 80, Change.BETTER), (0, 1, Change.WORSE),
        (0, 0, Change.SAME),
    ],
)  # fmt: skip
def test_counted_work_may_grow_by_a_fifth(accepted: int, now: int, verdict: Change) -> None:
    assert only(entry(contact_visits=accepted), entry(contact_visits=now)).verdict is verdict


def test_an_infinite_error_is_worse_than_any_and_no_worse_than_itself() -> None:
    assert only(entry(energy_lost=1.0), entry(energy_lost=math.inf)).change == math.inf
    assert only(entry(energy_lost=math.inf), entry(energy_lost=math.inf)).change == 0.0
    assert only(entry(energy_lost=math.inf), entry(energy_lost=1.0)).verdict is Change.BETTER


errors = st.floats(min_value=0.0, allow_nan=False)


@given(errors, errors, errors, st.floats(min_value=1e-300, max_value=1e-3))
def test_the_change_is_signed_antisymmetric_and_grows_with_the_value(
    a: float, b: float, c: float, floor: float
) -> None:
    assert signed_change(a, b, floor=floor) == -signed_change(b, a, floor=floor)
    assert signed_change(a, a, floor=floor) == 0.0
    low, high = sorted((b, c))
    assert signed_change(a, low, floor=floor) <= signed_change(a, high, floor=floor)


# What is missing, lost or new.


@pytest.mark.parametrize(
    ("now", "note"),
    [
        (None, "do not have this solver on this scene"),
        (Entry("crashed", 3, reason="killed by SIGSEGV"), "crashed: killed by SIGSEGV"),
        (Entry("timed out", 3, reason="killed at 120 s"), "timed out: killed at 120 s"),
        (Entry("not measured", 3, reason="planned and not done"), "not measured"),
        (Entry("refused", 3, reason="no friction"), "refused: no friction"),
        (Entry("measured", 5, {"energy lost": 0.0}), "another scene: 3 contacts accepted, 5 here"),
        (entry(energy_gained=0.0), "the number is not there any more"),
    ],
)
def test_what_the_baseline_has_and_the_results_have_not_fails(now: Entry | None, note: str) -> None:
    comparison = compare(
        baseline(qce=entry(energy_lost=0.0)), {} if now is None else {PAIR: now}, environment=HERE
    )  # fmt: skip
    missing = comparison.of(Change.MISSING)
    assert len(missing) == 1
    assert comparison.failures == missing
    assert note in missing[0].note


def test_new_pairs_and_numbers_are_reported_and_do_not_fail() -> None:
    now = {PAIR: entry(energy_lost=0.0, pulling_impulse=0.0), ("gr", SCENE): entry(energy_lost=0.5)}
    comparison = compare(baseline(qce=entry(energy_lost=0.0)), now, environment=HERE)
    assert not comparison.failures
    assert {(d.solver, d.metric) for d in comparison.of(Change.NEW)} == {("qce", "pulling impulse"), ("gr", "")}


def test_a_refusal_that_was_accepted_stays_one_and_an_answer_in_its_place_is_new() -> None:
    refused = Entry("refused", 3, reason="elastic only")
    assert only(refused, refused).verdict is Change.SAME
    assert only(refused, entry(energy_lost=0.5)).verdict is Change.NEW


def test_a_gate_that_compares_nothing_does_not_pass() -> None:
    with pytest.raises(BaselineError, match="no entry of gr"):
        compare(baseline(qce=entry(energy_lost=0.0)), {}, environment=HERE, solvers=["gr"])
    with pytest.raises(BaselineError, match="no entry at all"):
        compare(baseline(), {}, environment=HERE)


def test_the_worst_comes_first() -> None:
    accepted = entry(energy_lost=1e-9, energy_gained=1e-9, contact_visits=10)
    comparison = compare(
        baseline(qce=accepted, gr=entry(energy_lost=0.0)),
        {PAIR: entry(energy_lost=1e-8, energy_gained=1e-6, contact_visits=20)}, environment=HERE,
    )  # fmt: skip
    assert [d.metric or d.solver for d in comparison.failures] == [
        "gr", "energy gained", "energy lost", "contact visits",
    ]  # fmt: skip


# Reading a store.


def store_and_plan(*, seed: int = 0, **task: Any) -> tuple[HandmadeStore, int, list[PlannedTask]]:
    """A store with one task on the discs, and the plan that has it."""
    store = HandmadeStore()
    number = store.task("qce", "bernoulli", **task)
    return store, number, [PlannedTask(Task(Kind.IMPACT, "qce", "bernoulli", {}, seed), {}, SCENE)]


def test_gated_are_energy_momentum_one_sidedness_residuals_termination_and_work() -> None:
    store, task, plan = store_and_plan()
    for name, metric, value in (
        ("KIN", "energy gained", 1e-15), ("KIN", "energy lost", 2e-15), ("MOM", "worst momentum drift", 3e-15),
        ("ONE", "pulling impulse", 0.0), ("ONE", "remaining approach", 4e-15),
        ("termination", "stopping test missed", 0.0), ("error", "verification: natural map", 5e-15),
    ):  # fmt: skip
        store.score(task, name, value, metric=metric)
    store.score(task, "error", 0.3, metric="validation: Hertz", verdict="shown")
    store.score(task, "SYM", 0.4)
    store.score(task, "KIN", 0.5, metric="energy error e", verdict="shown")
    assert collect(store, plan)[PAIR] == Entry("measured", 3, {
        "energy gained": 1e-15, "energy lost": 2e-15, "momentum drift": 3e-15, "pulling impulse": 0.0,
        "remaining approach": 4e-15, "stopping test missed": 0.0, "verification: natural map": 5e-15,
        "contact visits": 10.0,
    })  # fmt: skip


def test_energy_that_an_inelastic_impact_loses_is_no_error() -> None:
    store, task, plan = store_and_plan()
    store.score(task, "KIN", 0.7, metric="energy lost", verdict="shown")
    assert "energy lost" not in collect(store, plan)[PAIR].values


def test_of_a_solve_that_was_cut_off_only_gated_rows_and_termination_count() -> None:
    store, task, plan = store_and_plan(status="iteration limit")
    store.score(task, "error", 0.1, metric="verification: energy", verdict="shown")
    store.score(task, "termination", 1.0, metric="stopping test missed", verdict="shown")
    store.score(task, "ONE", 0.0, metric="pulling impulse")
    assert set(collect(store, plan)[PAIR].values) == {"stopping test missed", "pulling impulse", "contact visits"}


def test_a_gated_number_that_could_not_be_had_is_infinite_and_what_does_not_apply_is_none() -> None:
    store, task, plan = store_and_plan()
    store.score(task, "KIN", math.nan, metric="energy gained", verdict="fail")
    store.score(task, "MOM", math.nan, metric="worst momentum drift", verdict="n/a")
    assert collect(store, plan)[PAIR].values == {"energy gained": math.inf, "contact visits": 10.0}


@pytest.mark.parametrize(
    ("outcome", "expected"), [(None, "not measured"), ("timed out", "timed out"), ("refused", "refused")]
)
def test_a_task_without_an_answer_keeps_its_reason(outcome: str | None, expected: str) -> None:
    store, _, plan = store_and_plan(outcome=outcome, reason="why")
    found = collect(store, plan)[PAIR]
    assert found.outcome == expected
    assert found.reason == ("why" if outcome else "planned and not done")


def test_tasks_of_another_seed_or_scene_are_not_taken_for_those_of_the_plan() -> None:
    store, _, _ = store_and_plan()
    _, _, plan = store_and_plan(seed=1)
    assert collect(store, plan) == {}


def test_the_plan_of_a_gate_is_the_single_impacts_of_the_tier() -> None:
    plan = gate.plan_gate(tier="smoke", seed=0, solvers=["qce", "qce"])
    assert len(plan) == len(TIERS["smoke"])
    whole = plan_tasks([choose_solver("qce")], tier="smoke", seed=0)
    assert len(whole) == len(plan) + len(SWEEPS)


# Accepting.


def accepted(measured: Mapping[gate.Pair, Entry], old: Baseline | None = None, **change: Any) -> Baseline:
    """Accept with the usual arguments."""
    plan = [PlannedTask(Task(Kind.IMPACT, solver, "bernoulli", {}, 0), {}, scene) for solver, scene in measured]
    arguments: dict[str, Any] = {
        "plan": plan, "tier": "smoke", "seed": 0, "solvers": None, "environment": HERE, "reason": "because",
    }  # fmt: skip
    return gate.accept(measured, old, **(arguments | change))


def test_the_history_holds_the_signed_difference_with_reason_date_version_and_commit() -> None:
    old = accepted({PAIR: entry(energy_lost=1e-9, energy_gained=1e-9, contact_visits=100)}, reason="first")
    new = accepted(
        {PAIR: entry(energy_lost=1e-7, energy_gained=1e-12, contact_visits=100)}, old, reason=" second \n try "
    )
    assert [record["reason"] for record in new.history] == ["first", "second try"]
    record = new.history[-1]
    assert {"date", "version", "commit"} <= record.keys()
    decades: Any = record["decades"]
    assert decades["energy lost"] == {"changed": 1, "largest": pytest.approx(2.0, abs=DIGIT), "smallest": 0}
    assert decades["energy gained"] == {"changed": 1, "largest": 0, "smallest": pytest.approx(-3.0, abs=DIGIT)}
    assert "contact visits" not in decades
    beyond: Any = record["beyond allowance"]
    assert ["qce", SCENE, "energy lost", pytest.approx(2.0, abs=DIGIT)] in beyond
    assert len(beyond) == 2


def test_accepting_one_solver_leaves_the_others_as_they_are() -> None:
    old = baseline(qce=entry(energy_lost=0.0), gr=entry(energy_lost=0.25))
    new = accepted({PAIR: entry(energy_lost=0.5)}, old, solvers=["qce"])
    assert new.entries["gr", SCENE].values == {"energy lost": 0.25}
    assert new.entries[PAIR].values == {"energy lost": 0.5}


def test_what_is_removed_is_named() -> None:
    old = baseline(qce=entry(energy_lost=0.0), gr=entry(energy_lost=0.25))
    new = accepted({PAIR: entry(energy_lost=0.0)}, old)
    assert new.history[-1]["removed"] == [f"gr on {SCENE}"]


@pytest.mark.parametrize(
    ("measured", "change", "words"),
    [
        ({PAIR: entry(energy_lost=0.0)}, {"reason": " \n"}, "needs a reason"),
        ({PAIR: Entry("crashed", 3)}, {}, "qce on bernoulli\\(\\): crashed"),
        ({}, {}, "of every solver on every scene"),
        ({PAIR: entry(energy_lost=0.0)}, {"tier": "default"}, "tier smoke, not default"),
        ({PAIR: entry(energy_lost=0.0)}, {"seed": 1}, "seed 0, not 1"),
        (
            {PAIR: entry(energy_lost=0.0)},
            {"plan": [PlannedTask(Task(Kind.IMPACT, "gr", "bernoulli", {}, 0), {}, SCENE)]}, "gr on .*: not measured",
        ),
    ],
)  # fmt: skip
def test_only_sound_results_with_a_reason_are_accepted(
    measured: Mapping[gate.Pair, Entry], change: dict[str, Any], words: str
) -> None:
    with pytest.raises(BaselineError, match=words):
        accepted(measured, baseline(qce=entry(energy_lost=0.0)), **change)


# The file.


def test_a_baseline_comes_back_as_it_was_written(tmp_path: Path) -> None:
    made = accepted({
        PAIR: entry(energy_lost=1.2344567e-9, contact_visits=123456, energy_gained=math.inf),
        ("gr", SCENE): Entry("refused", 3, reason="elastic only"),
    })  # fmt: skip
    gate.write_baseline(tmp_path / "new folder" / "b.json", made)
    read = gate.read_baseline(tmp_path / "new folder" / "b.json")
    assert read.entries == made.entries
    assert read.entries[PAIR].values == {"energy lost": 1.234e-9, "contact visits": 123456, "energy gained": math.inf}
    assert read.history == made.history
    assert (read.tier, read.seed, read.solvers) == ("smoke", 0, None)
    # Rounding to the figures that are kept is no change.
    assert not compare(read, made.entries, environment=HERE).failures


def test_the_file_has_one_line_for_each_entry(tmp_path: Path) -> None:
    gate.write_baseline(tmp_path / "b.json", accepted({PAIR: entry(energy_lost=0.0)}))
    lines = [line for line in (tmp_path / "b.json").read_text().splitlines() if '"scene"' in line]
    assert len(lines) == 1
    json.loads((tmp_path / "b.json").read_text())


def test_a_baseline_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "b.json"
    gate.write_baseline(path, accepted({PAIR: entry(energy_lost=0.0)}))
    before = path.read_bytes()

    def full(_file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BaselineError, match="No space left on device; it is as it was"):
        gate.write_baseline(path, accepted({PAIR: entry(energy_lost=1.0)}))
    assert path.read_bytes() == before
    assert [child.name for child in tmp_path.iterdir()] == ["b.json"]


SOUND: dict[str, Any] = {
    "schema": 1, "tier": "smoke", "seed": 0, "solvers": None, "environment": {}, "history": [],
    "entries": [{
        "solver": "qce", "scene": SCENE, "contacts": 3, "outcome": "measured", "values": {"energy lost": 0.0}
    }],
}  # fmt: skip


def spoiled(**change: Any) -> dict[str, Any]:
    """A sound file with other fields; "entry" changes the entry."""
    made: dict[str, Any] = json.loads(json.dumps(SOUND))
    made["entries"][0].update(change.pop("entry", {}))
    return made | change


BAD: dict[str, tuple[object, str]] = {
    "no JSON": ("{", "no JSON"),
    "NaN": ('{"schema": NaN}', "NaN is no number"),
    "a list": ([], "must hold a JSON object"),
    "another schema version": (spoiled(schema=2), "schema version 2, and this impactbench reads 1"),
    "no schema version": ({}, "schema version None"),
    "an unknown tier": (spoiled(tier="smok"), "unknown tier 'smok'; did you mean smoke"),
    "a missing field": ({key: value for key, value in SOUND.items() if key != "seed"}, "seed is missing"),
    "a truth value as seed": (spoiled(seed=True), "seed must be of type int"),
    "no entries": (spoiled(entries=[]), "has no entries"),
    "an entry that is no object": (spoiled(entries=[3]), "entry 0 must be an object"),
    "an entry twice": (spoiled(entries=SOUND["entries"] * 2), "is there twice"),
    "an entry without values": (spoiled(entry={"values": {}}), "entry 0: it is measured and has no values"),
    "an unknown metric": (
        spoiled(entry={"values": {"energie lost": 0.0}}), "unknown metric 'energie lost'; did you mean energy lost"
    ),
    "a negative value": (spoiled(entry={"values": {"energy lost": -1.0}}), "energy lost must be a number ≥ 0"),
    "a word as value": (spoiled(entry={"values": {"energy lost": "small"}}), "energy lost must be a number ≥ 0"),
    "an unknown outcome": (spoiled(entry={"outcome": "crashed"}), "must be measured or refused"),
    "negative contacts": (spoiled(entry={"contacts": -1}), "contacts must be ≥ 0"),
    "a history of words": (spoiled(history=["long ago"]), "history must hold objects"),
    "solvers that are no list": (spoiled(solvers="qce"), "null or a list of names"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD)
def test_a_baseline_that_cannot_be_used_ends_with_exit_code_2_and_stays(fault: str, tmp_path: Path) -> None:
    content, words = BAD[fault]
    path = tmp_path / "b.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    before = path.read_bytes()
    with pytest.raises(BaselineError) as caught:
        gate.read_baseline(path)
    assert words in str(caught.value)
    for command in (["check"], ["accept", "--reason", "why"]):
        result = call(*command, "--baseline", str(path), "--out", str(tmp_path / "out"), "--no-measure")
        assert result.exit_code == 2
        assert str(path) in result.output
    assert path.read_bytes() == before


def test_a_sound_file_is_read() -> None:
    assert gate._parse(SOUND).entries == {PAIR: entry(energy_lost=0.0)}


def test_what_is_not_a_readable_file_is_said(tmp_path: Path) -> None:
    for path, words in ((tmp_path, "cannot read"), (tmp_path / "none.json", "there is no baseline")):
        with pytest.raises(BaselineError, match=words):
            gate.read_baseline(path)


# The report.


def comparison() -> Comparison:
    accepted_entry = entry(energy_lost=2e-9, contact_visits=100, energy_gained=1e-3)
    now = {PAIR: entry(energy_lost=1e-8, contact_visits=150, energy_gained=1e-6)}
    old = replace(baseline(qce=accepted_entry, gr=entry(energy_lost=0.0)), history=({"reason": "a | b", "date": "d"},))
    return compare(old, now, environment={**HERE, "cpu": "another"})


def printed(render: Callable[[Console], None]) -> str:
    """What a wide terminal shows."""
    console = Console(width=160, file=io.StringIO())
    render(console)
    shown = console.file
    assert isinstance(shown, io.StringIO)
    return shown.getvalue()


def test_the_report_says_what_got_worse_and_by_how_much() -> None:
    for text in (printed(lambda console: render_gate(comparison(), console)), gate_markdown(comparison())):
        for words in (
            "+0.70 decades", "× 1.5", "× 1.2", "energy lost", SCENE, "2e-9", "1e-8", "gr", "-3.00 decades",
            "2 of 4 numbers got worse", "1 missing", "another environment", "cpu: a_cpu accepted, another here",
        ):  # fmt: skip
            assert words in text
    assert "Nothing got worse" not in gate_markdown(comparison())


def test_a_passing_report_says_so_and_counts() -> None:
    now = {PAIR: entry(energy_lost=0.0), ("gr", SCENE): entry(energy_lost=0.0)}
    same = compare(baseline(qce=entry(energy_lost=0.0)), now, environment=HERE)
    assert "Nothing got worse: 1 numbers compared" in gate_markdown(same), "what is new has nothing to be compared with"
    assert "1 new" in gate_markdown(same)
    assert "another environment" not in gate_markdown(same)


def ratio(median: float) -> TimeRatio:
    return TimeRatio("qce", SCENE, 2e-3 * median, 2e-3, median, 0.9 * median, 1.1 * median)


def test_times_are_gated_on_the_median_ratio_and_the_spread_is_shown() -> None:
    times = TimeComparison("0123abc", 15, (ratio(1.3), ratio(1.2)), ("gr on x: refused: no",))
    assert [row.median for row in times.slower] == [1.3]
    text = printed(lambda console: render_times(times, console))
    for words in ("× 1.30", "1.17 … 1.43", "1 of 2 solves got slower", "not timed: gr on x"):
        assert words in text
        assert words in gate_markdown(comparison(), times)


def test_quartiles_are_those_of_the_rounds() -> None:
    assert quartiles([3.0, 1.0, 2.0, 5.0, 4.0]) == (2.0, 3.0, 4.0)


# The commands.


def call(*arguments: str) -> Result:
    return CliRunner().invoke(impactbench.main, arguments)


ANSWER = """
    @dataclass(frozen=True)
    class MyLaw:
        \"\"\"Elastic collisions, one contact after the other.\"\"\"

        slack: float = 0.0

        def solve(self, problem):
            u, impulse, W, visits = problem.u_pre.copy(), np.zeros(problem.m), problem.W.toarray(), 0
            for _ in range(20):
                for i in range(problem.m):
                    visits += 1
                    if u[i] < -1e-10 * problem.speed:
                        p = -(2.0 - SLACK) * u[i] / W[i, i]
                        impulse[i] += p
                        u += p * W[i]
                if u.min(initial=0.0) >= -1e-10 * problem.speed:
                    break
            return ImpactSolution(impulse, problem.v_after(impulse), Status.ITERATION_LIMIT, 1, visits)
"""


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory, write_solver: Callable[[Path, str], Path]) -> dict[str, Path]:
    """A solver of a user's own with its accepted baseline, made by the command."""
    folder = tmp_path_factory.mktemp("gated")
    law = write_solver(folder, ANSWER.replace("SLACK", "0.0"))
    paths = {"folder": folder, "law": law, "baseline": folder / "b.json", "out": folder / "out"}
    result = call(
        "accept", "--solver", f"{law}:MyLaw", "--baseline", str(paths["baseline"]), "--out", str(paths["out"]),
        "--jobs", "1", "--reason", "first",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return paths


def gate_arguments(gated: Mapping[str, Path], **change: Path) -> list[str]:
    paths = {**gated, **change}
    return ["--baseline", str(paths["baseline"]), "--out", str(paths["out"]), "--jobs", "1"]


def test_accept_writes_what_check_then_passes(gated: Mapping[str, Path], tmp_path: Path) -> None:
    written = gate.read_baseline(gated["baseline"])
    assert written.solvers == (f"{gated['law']}:MyLaw",)
    assert len(written.entries) == len(TIERS["smoke"])
    report = tmp_path / "check.md"
    result = call("check", *gate_arguments(gated), "--tier", "smoke", "--report", str(report))
    assert result.exit_code == 0, result.output
    assert "Nothing got worse" in result.output
    assert "Nothing got worse" in report.read_text(encoding="utf-8")


def test_a_solver_that_gets_worse_fails_the_check_and_accept_records_by_how_much(
    gated: Mapping[str, Path], tmp_path: Path, write_solver: Callable[[Path, str], Path]
) -> None:
    # The same file name with another law: every impulse is a millionth too small.
    law, before = gated["law"], gated["law"].read_text(encoding="utf-8")
    mine = tmp_path / "b.json"
    shutil.copy(gated["baseline"], mine)
    try:
        write_solver(gated["folder"], ANSWER.replace("SLACK", "1e-6"))
        arguments = gate_arguments(gated, baseline=mine, out=tmp_path / "out")
        result = call("check", *arguments)
        assert result.exit_code == 1, result.output
        assert "decades" in result.output
        assert "got worse" in result.output
        assert mine.read_bytes() == gated["baseline"].read_bytes()
        result = call("accept", *arguments, "--reason", "softer balls")
        assert result.exit_code == 0, result.output
    finally:
        law.write_text(before, encoding="utf-8")
    record: Any = gate.read_baseline(mine).history[-1]
    assert record["reason"] == "softer balls"
    assert (
        record["decades"]["verification: energy" if "verification: energy" in record["decades"] else "energy lost"][
            "largest"
        ]
        > 1.0
    )


def test_a_pair_that_was_never_measured_fails_the_check(gated: Mapping[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(gated["out"] / FILE_NAME, out / FILE_NAME)
    with sqlite3.connect(out / FILE_NAME) as connection:
        (task,) = connection.execute("SELECT min(task) FROM tasks").fetchone()
        connection.execute("DELETE FROM scores WHERE task = ?", (task,))
        connection.execute("DELETE FROM series WHERE task = ?", (task,))
        connection.execute("DELETE FROM tasks WHERE task = ?", (task,))
        connection.execute("UPDATE tasks SET outcome = 'crashed', reason = 'SIGSEGV' WHERE task = ?", (task + 1,))
    connection.close()
    result = call("check", *gate_arguments(gated, out=out), "--no-measure")
    assert result.exit_code == 1
    assert "2 missing" in result.output
    # Without --no-measure the pair that was never planned is measured; the crash stays a crash.
    result = call("check", *gate_arguments(gated, out=out))
    assert result.exit_code == 1
    assert "1 missing" in result.output


def changed(out: Path, to: Path, statement: str) -> Path:
    """A results folder like another one, but for what a statement changes."""
    to.mkdir()
    shutil.copy(out / FILE_NAME, to / FILE_NAME)
    with sqlite3.connect(to / FILE_NAME) as connection:
        connection.executescript(statement)
    connection.close()
    return to


def test_two_results_folders_are_compared_in_either_direction(gated: Mapping[str, Path], tmp_path: Path) -> None:
    assert "Nothing got worse" in call("compare", str(gated["out"]), str(gated["out"])).output
    worse = changed(gated["out"], tmp_path / "worse", """
        UPDATE scores SET value = 0.001
        WHERE score = (SELECT min(score) FROM scores WHERE name = 'KIN' AND metric = 'energy gained')
    """)  # fmt: skip
    report = tmp_path / "compare.md"
    result = call("compare", str(gated["out"]), str(worse), "--report", str(report))
    assert result.exit_code == 1, result.output
    assert re.search(r"1 of \d+ numbers got worse, most of all energy gained", " ".join(result.output.split()))
    assert "results in" in report.read_text(encoding="utf-8")
    result = call("compare", str(worse), str(gated["out"]))
    assert result.exit_code == 0, result.output
    assert "Got better" in result.output


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("DELETE FROM scores; DELETE FROM series; DELETE FROM tasks", "no solver has an answer"),
        ("UPDATE runs SET settings = replace(settings, '\"smoke\"', '\"default\"')", "of tier smoke, not default"),
    ],
)
def test_results_that_cannot_be_compared_end_with_exit_code_2(
    statement: str, words: str, gated: Mapping[str, Path], tmp_path: Path
) -> None:
    other = changed(gated["out"], tmp_path / "other", statement)
    result = call("compare", str(gated["out"]), str(other))
    assert result.exit_code == 2, result.output
    assert words in " ".join(result.output.split())
    assert call("compare", str(gated["out"]), str(tmp_path)).exit_code == 2


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (b"not a database at all, and longer than a header is........................................", "damaged"),
        (b"", "no impactbench store"),
    ],
)
def test_a_spoiled_store_is_said_and_nothing_is_overwritten(
    fault: bytes, words: str, gated: Mapping[str, Path], tmp_path: Path
) -> None:
    store, mine = tmp_path / FILE_NAME, tmp_path / "b.json"
    store.write_bytes(fault)
    shutil.copy(gated["baseline"], mine)
    for command in (["check"], ["accept", "--reason", "why"]):
        result = call(*command, *gate_arguments(gated, out=tmp_path, baseline=mine), "--no-measure")
        assert result.exit_code == 2
        assert words in result.output
    assert store.read_bytes() == fault
    assert mine.read_bytes() == gated["baseline"].read_bytes()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--tier", "default"], "of tier smoke, not default"),
        (["--solver", "qce"], "no entry of qce"),
        (["--solver", "qcee"], "did you mean"),
        (["--no-measure", "--fresh"], "nothing to compare"),
    ],
)
def test_a_check_that_cannot_be_made_ends_with_exit_code_2(
    change: list[str], words: str, gated: Mapping[str, Path]
) -> None:
    result = call("check", *gate_arguments(gated), *change)
    assert result.exit_code == 2
    assert words in result.output


@pytest.mark.parametrize(
    ("key", "other", "words"),
    [
        ("machine", "vax", "architecture vax, not"),
        ("os", "Plan9 4", "operating system Plan9, not"),
        ("impactbench", "9.9.9", "version of impactbench 9.9.9, not"),
    ],
)
def test_a_baseline_of_another_machine_or_version_is_refused_unless_asked_for(
    key: str, other: str, words: str, gated: Mapping[str, Path], tmp_path: Path
) -> None:
    content = json.loads(gated["baseline"].read_text(encoding="utf-8"))
    content["environment"][key] = other
    mine = tmp_path / "b.json"
    mine.write_text(json.dumps(content), encoding="utf-8")
    result = call("check", *gate_arguments(gated, baseline=mine), "--no-measure")
    assert result.exit_code == 2
    assert words in result.output
    assert "--foreign" in result.output
    result = call("check", *gate_arguments(gated, baseline=mine), "--no-measure", "--foreign")
    assert result.exit_code == 0
    assert other in result.output


def test_another_processor_and_release_are_no_other_kind_of_machine(gated: Mapping[str, Path], tmp_path: Path) -> None:
    content = json.loads(gated["baseline"].read_text(encoding="utf-8"))
    content["environment"]["cpu"] = "another one"
    content["environment"]["os"] += ".1"
    mine = tmp_path / "b.json"
    mine.write_text(json.dumps(content), encoding="utf-8")
    result = call("check", *gate_arguments(gated, baseline=mine), "--no-measure")
    assert result.exit_code == 0
    assert "another one" in result.output


def test_accept_refuses_an_empty_reason_before_it_measures(gated: Mapping[str, Path], tmp_path: Path) -> None:
    before = gated["baseline"].read_bytes()
    for reason in (["--reason", " "], []):
        result = call("accept", *gate_arguments(gated, out=tmp_path / "out"), *reason)
        assert result.exit_code == 2
    assert gated["baseline"].read_bytes() == before
    assert not (tmp_path / "out").exists()


def test_a_commit_that_git_does_not_know_is_bad_input(
    gated: Mapping[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from harness.revision import time_against

    monkeypatch.chdir(tmp_path)
    with pytest.raises(RevisionError):
        time_against("HEAD", [], timeout_s=10, on_progress=lambda line: None)
    result = call("check", *gate_arguments(gated, out=tmp_path / "out"), "--against", "no-such-commit")
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists(), "it is found before anything is measured"


def test_the_fixture_gates_one_solver_and_lists_what_got_worse(
    gated: Mapping[str, Path], tmp_path: Path, impact_gate: ImpactGate
) -> None:
    solver = f"{gated['law']}:MyLaw"
    stricter = json.loads(gated["baseline"].read_text(encoding="utf-8"))
    for row in stricter["entries"]:
        row["values"]["contact visits"] = 1
    (tmp_path / "b.json").write_text(json.dumps(stricter), encoding="utf-8")
    with pytest.raises(AssertionError, match=r"MyLaw on newtons-cradle.*: contact visits: 1 accepted, .* decades"):
        impact_gate(solver, baseline=tmp_path / "b.json")
    # What was measured is kept for the test: the second comparison measures nothing.
    assert not impact_gate(solver, baseline=gated["baseline"]).failures
    with pytest.raises(BaselineError, match="no entry of qce"):
        impact_gate("qce", baseline=gated["baseline"])


# What is checked in.


def test_the_checked_in_baseline_is_sound_and_of_the_smoke_tier() -> None:
    checked_in = gate.read_baseline(ROOT / "baselines" / "smoke.json")
    assert checked_in.tier == "smoke"
    assert checked_in.solvers is None
    assert all(record["reason"] for record in checked_in.history)
    labels = {planned.label for planned in gate.plan_gate(tier="smoke", seed=0, solvers=["qce"])}
    assert {scene for _, scene in checked_in.entries} == labels


def test_the_environment_that_is_kept_names_no_user_host_or_folder() -> None:
    assert set(gate._ENVIRONMENT) <= describe_environment().keys()
