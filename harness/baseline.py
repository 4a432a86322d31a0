"""The regression gate: results against an accepted baseline, one-sided, on a logarithm with a floor.

    change = log10 max(value, floor) - log10 max(accepted, floor),   floor = 8 eps m      worse where change > allowance

An absolute tolerance would pass an energy error that grew from 2e-9 to 1e-8; a factor of five is a factor of five here.
Below the floor (eps the spacing of float64 at 1, m the contacts of the scene) everything is rounding. Gated are the
single impacts of one tier: energy, momentum, one-sidedness, symmetry, residuals, termination, and counted work. They
are deterministic up to rounding: a baseline of another processor of the same kind holds, and is named in the report;
one of another architecture, operating system or version of impactbench is refused unless it is asked for. Wall time is
in no baseline: `harness.revision` compares it with another commit within one job.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from harness.desiderata import SYMMETRY_TOLERANCE
from harness.environment import describe_environment
from harness.files import replace_file
from harness.measurement import Kind, Outcome, Verdict
from harness.results import Frames, Results, ScoreRow, TaskRow
from harness.run import plan_tasks
from harness.selection import build_scenario, choose_solver, judged_solvers, unknown
from harness.store import PlannedTask
from scenarios.tiers import TIERS
from solvers import Status

SCHEMA_VERSION = 1
# A product of three rounded matrices and a sum over m contacts: 8 eps m bounds what exact arithmetic would not show.
FLOOR_PER_CONTACT = 8 * float(np.finfo(np.float64).eps)
# Machines round differently (fused multiply-add, vector width, BLAS), and a residual that ends one sweep earlier or
# later lies anywhere below its tolerance: half a decade, a factor of 3.2. From 2e-9 to 1e-8 is 0.7 decades and fails.
# Code for a generic x86-64 processor with another BLAS kernel moved no error of the smoke tier by 1e-3 decades.
ERROR_ALLOWANCE = 0.5
# Counted work is the same but where rounding decides a tie: with that other kernel one of 88 counts changed, by 9 %
# (NNLS on the symmetric rack, whose active set may be built in more than one order).
WORK_ALLOWANCE = math.log10(1.2)
# Figures that are kept of a number: a thousandth of its value is 4e-4 decades.
KEPT_FIGURES = 4

# Solvers × scenes that an error names.
SHOWN_UNFIT = 5

WORK = "contact visits"
RESIDUAL = "verification: "
IMPACT = Kind.IMPACT.value
_METRICS = {
    ("KIN", "energy gained"): "energy gained",
    ("KIN", "energy lost"): "energy lost",
    ("MOM", "worst momentum drift"): "momentum drift",
    ("ONE", "pulling impulse"): "pulling impulse",
    ("ONE", "remaining approach"): "remaining approach",
    ("SYM", "worst symmetry residual"): "symmetry residual",
    ("SYM", "worst renumbering residual"): "renumbering residual",
    ("termination", "stopping test missed"): "stopping test missed",
}
# How many images of a scene are tried depends on the work of a solve, and each is solved to a tolerance: what is within
# the bound of SYM says nothing of a trend.
_FLOORS = dict.fromkeys(("symmetry residual", "renumbering residual"), SYMMETRY_TOLERANCE)
METRICS = (*_METRICS.values(), WORK)
"""What is gated, beside every metric that begins with RESIDUAL."""

# The environment's entries in which a baseline must agree with the machine it is used on, with their names. Of the
# operating system the kind counts, not the release.
_KIND = {"impactbench": "version of impactbench", "machine": "architecture", "os": "operating system"}
_ENVIRONMENT = ("impactbench", "source", "commit", "python", "numpy", "scipy", "numba", "cpu", "machine", "os")

Pair: TypeAlias = tuple[str, str]
"""Solver specification and label of the scene."""


class BaselineError(ValueError):
    """A baseline cannot be read, used or made; the text says why and what to do. No file was changed."""


class Change(Enum):
    """What became of one number or of one pair of solver and scene."""

    WORSE = "worse"
    MISSING = "missing"
    """The baseline has it, and the results have not: not measured, lost, refused now, or of another scene."""
    NEW = "new"
    """The results have it, and the baseline has not."""
    BETTER = "better"
    SAME = "same"
    """Within the allowance on either side."""


FAILING = (Change.WORSE, Change.MISSING)


@dataclass(frozen=True)
class Entry:
    """What one solver came to on one scene."""

    outcome: str
    """Value of an `Outcome`, or "not measured" for a task that is planned and not done."""
    contacts: int
    """m of the scene."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Metric → value, ≥ 0, dimensionless or a count; infinite where a gated number was NaN."""
    reason: str = ""
    """Why nothing was measured."""


@dataclass(frozen=True)
class Baseline:
    """Numbers that were accepted, with what made them and every acceptance before."""

    tier: str
    seed: int
    """Base seed of the run."""
    solvers: tuple[str, ...] | None
    """Specifications of the solvers that are gated; None for every solver that has a name."""
    environment: Mapping[str, object]
    """Versions and machine of the accepted results."""
    entries: Mapping[Pair, Entry]
    history: tuple[Mapping[str, object], ...] = ()
    """One record an acceptance, the latest last: date, version, commit, reason, and what changed by how much."""


@dataclass(frozen=True)
class Difference:
    """One number beside the accepted one, or one pair that stands on one side only."""

    solver: str
    scene: str
    metric: str
    """Empty where the whole pair is missing or new."""
    accepted: float
    value: float
    """NaN where there is none."""
    change: float
    """Signed: log10 of value over accepted, both at least the floor [decades]; > 0 is worse. NaN where one lacks."""
    allowance: float
    """Change up to which the number counts as the same [decades]."""
    verdict: Change
    note: str = ""
    """What is missing, and why."""

    @property
    def sentence(self) -> str:
        """The difference in one line."""
        where = f"{self.solver} on {self.scene}"
        if math.isnan(self.change):
            return f"{where}: {self.metric or 'all'}: {self.verdict.value}: {self.note}"
        change = f"{self.change:+.2f} decades, allowed {self.allowance:+.2f}"
        return f"{where}: {self.metric}: {self.accepted:.3g} accepted, {self.value:.3g} now ({change})"


@dataclass(frozen=True)
class Comparison:
    """Results against a baseline."""

    baseline: Baseline
    environment: Mapping[str, object]
    """Of the results."""
    differences: tuple[Difference, ...]

    @property
    def failures(self) -> tuple[Difference, ...]:
        """What got worse or is missing, the largest change first."""
        failing = [difference for difference in self.differences if difference.verdict in FAILING]
        return tuple(sorted(failing, key=lambda difference: -_sortable(difference.change)))

    def of(self, verdict: Change) -> tuple[Difference, ...]:
        """All differences with one verdict."""
        return tuple(difference for difference in self.differences if difference.verdict is verdict)

    @property
    def elsewhere(self) -> tuple[str, ...]:
        """What differs between the two environments, each as "key: accepted, now"; the code itself is meant to."""
        keys = [key for key in _ENVIRONMENT if key not in ("source", "commit")]
        pairs = [(key, self.baseline.environment.get(key), self.environment.get(key)) for key in keys]
        return tuple(f"{key}: {old} accepted, {new} here" for key, old, new in pairs if old != new)


def plan_gate(*, tier: str, seed: int, solvers: Sequence[str] | None) -> list[PlannedTask]:
    """List the single impacts that a baseline stands on.

    Args:
        tier: name in `TIERS`.
        seed: base seed.
        solvers: specifications; None for every solver that has a name.

    Raises:
        SelectionError: a solver or the tier does not exist.
    """
    choices = {
        choice.specification: choice
        for choice in (choose_solver(name) for name in (judged_solvers() if solvers is None else solvers))
    }
    plan = plan_tasks(list(choices.values()), tier=tier, seed=seed)
    return [planned for planned in plan if planned.task.kind.value == IMPACT]


def collect(store: Frames, plan: Sequence[PlannedTask] | None = None) -> dict[Pair, Entry]:
    """Read what a store has of the tasks of a plan; tasks that it does not have are left out.

    Args:
        store: of a results folder.
        plan: single impacts; None for all that the store has.

    Raises:
        ResultsError: the store has rows that cannot be read.
    """
    rows: dict[str, list[ScoreRow]] = {}
    results = Results(store)
    for row in results.scores:
        rows.setdefault(row.task.task, []).append(row)
    tasks = [task for task in results.tasks if task.kind == IMPACT]
    if plan is not None:
        seeds = _task_seeds(store)
        wanted = {(planned.task.solver, planned.label, planned.task.seed) for planned in plan}
        tasks = [task for task in tasks if (task.solver, task.label, seeds[task.task]) in wanted]
    contacts: dict[str, int] = {}
    entries = {}
    for task in tasks:
        if task.label not in contacts:
            contacts[task.label] = build_scenario(task.scenario, task.parameters).problem.m
        entries[task.solver, task.label] = _entry(task, rows.get(task.task, ()), contacts=contacts[task.label])
    return entries


def as_baseline(store: Frames, reason: str) -> Baseline:
    """Take all single impacts of a results folder for accepted, lost ones left out.

    Args:
        store: of the folder.
        reason: for the record: where they come from.

    Raises:
        BaselineError: it has no answer to a single impact.
        ResultsError: the store has rows that cannot be read.
    """
    entries = {pair: entry for pair, entry in collect(store).items() if not _is_lost(entry)}
    if not entries:
        raise BaselineError(f"{reason}: no solver has an answer to a single impact there")
    settings, environment = store.frame("runs").iloc[-1]["settings"], latest_environment(store)
    record = {
        "date": datetime.now(UTC).date().isoformat(), "version": environment.get("impactbench"),
        "commit": environment.get("commit"), "reason": reason,
    }  # fmt: skip
    kept = {key: environment.get(key) for key in _ENVIRONMENT}
    return Baseline(settings["tier"], settings["seed"], None, kept, entries, (record,))


def compare(
    baseline: Baseline,
    measured: Mapping[Pair, Entry],
    *,
    environment: Mapping[str, object],
    solvers: Sequence[str] | None = None,
) -> Comparison:
    """Compare results with a baseline.

    Args:
        baseline: what was accepted.
        measured: from `collect`, at the baseline's tier and seed.
        environment: of the results.
        solvers: only entries of these specifications; None for all.

    Raises:
        BaselineError: the baseline has nothing of one of these solvers.
    """
    differences: list[Difference] = []
    for pair, entry in gated_entries(baseline, solvers).items():
        differences += _compare_pair(pair, entry, measured.get(pair))
    differences += [
        Difference(*pair, "", math.nan, math.nan, math.nan, math.nan, Change.NEW, entry.reason)
        for pair, entry in measured.items()
        if pair not in baseline.entries
    ]
    return Comparison(baseline, dict(environment), tuple(differences))


def gated_entries(baseline: Baseline, solvers: Sequence[str] | None) -> dict[Pair, Entry]:
    """The entries of these solvers; of all where None.

    Raises:
        BaselineError: one of them has none: a gate that compares nothing must not pass.
    """
    entries = {pair: entry for pair, entry in baseline.entries.items() if solvers is None or pair[0] in solvers}
    absent = sorted(set(solvers or ()) - {solver for solver, _ in entries})
    if absent or not entries:
        what = f"no entry of {', '.join(absent)}" if absent else "no entry at all"
        raise BaselineError(f"the baseline has {what}: accept one first with `impactbench accept`")
    return entries


def accept(
    measured: Mapping[Pair, Entry],
    old: Baseline | None,
    *,
    plan: Sequence[PlannedTask],
    tier: str,
    seed: int,
    solvers: Sequence[str] | None,
    environment: Mapping[str, object],
    reason: str,
) -> Baseline:
    """Make a new baseline of results, with the signed differences to the old one in its history.

    Args:
        measured: from `collect`.
        old: the baseline that is replaced; None for a first one.
        plan: what should have been measured.
        tier: of the results.
        seed: of the results.
        solvers: specifications that are accepted; all others stay as they are in `old`. None for all that are gated.
        environment: of the results.
        reason: why the new numbers are right; one who reads the history must be able to judge it.

    Raises:
        BaselineError: no reason, no results, results that are lost or not measured, or another tier or seed.
    """
    reason = checked_reason(reason)
    if old is not None:
        check_same_run(old, tier=tier, seed=seed)
    unfit = [f"{solver} on {scene}: {entry.outcome}" for (solver, scene), entry in measured.items() if _is_lost(entry)]
    pairs = {(planned.task.solver, planned.label) for planned in plan}
    unfit += [f"{solver} on {scene}: not measured" for solver, scene in sorted(pairs - measured.keys())]
    if unfit or not measured:
        some = f"{'; '.join(unfit[:SHOWN_UNFIT])}{' …' if len(unfit) > SHOWN_UNFIT else ''}"
        raise BaselineError(f"a baseline needs an answer or a refusal of every solver on every scene: {some or 'none'}")
    before = old.entries if old else {}
    kept_entries = {pair: entry for pair, entry in before.items() if solvers is not None and pair[0] not in solvers}
    entries = dict(sorted({**kept_entries, **{pair: _rounded(entry) for pair, entry in measured.items()}}.items()))
    kept = {key: environment.get(key) for key in _ENVIRONMENT}
    record: dict[str, object] = {
        "date": datetime.now(UTC).date().isoformat(), "version": kept["impactbench"], "commit": kept["commit"],
        "reason": reason, **_changes(old, entries, kept),
    }  # fmt: skip
    return Baseline(tier, seed, _scope(old, solvers), kept, entries, (*(old.history if old else ()), record))


def checked_reason(reason: str) -> str:
    """The reason in one line.

    Raises:
        BaselineError: it says nothing.
    """
    if not reason.strip():
        raise BaselineError("a baseline needs a reason: say why the new numbers are right")
    return " ".join(reason.split())


def check_same_run(baseline: Baseline, *, tier: str, seed: int) -> None:
    """Refuse to compare runs of different scenes or disturbances.

    Raises:
        BaselineError: the tier or the seed is another one.
    """
    for what, accepted, now in (("tier", baseline.tier, tier), ("seed", baseline.seed, seed)):
        if accepted != now:
            raise BaselineError(f"the baseline is of {what} {accepted}, not {now}: they cannot be compared")


def check_same_kind(baseline: Baseline, environment: Mapping[str, object]) -> None:
    """Refuse a baseline of another version or kind of machine.

    Args:
        baseline: what was accepted.
        environment: where it is compared.

    Raises:
        BaselineError: names what differs, and what to do.
    """
    for key, name in _KIND.items():
        accepted, now = (str(found.get(key)).partition(" ")[0] for found in (baseline.environment, environment))
        if accepted != now:
            raise BaselineError(
                f"the baseline is of another machine or version: {name} {accepted}, not {now}; accept one here with "
                "`impactbench accept`, or compare all the same with --foreign"
            )


def latest_environment(store: Frames) -> dict[str, object]:
    """Environment of a store's last run; of this process where the store says nothing."""
    records = store.frame("runs").to_dict("records")
    found = records[-1].get("environment") if records else None
    return dict(found) if isinstance(found, Mapping) and found else describe_environment()


def read_baseline(path: Path) -> Baseline:
    """Read a baseline and check all of it.

    Raises:
        BaselineError: there is no such file, it is not readable, of another schema, or one of its rows is not sound.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
    except FileNotFoundError:
        raise BaselineError(
            f"there is no baseline {path}: make one with `impactbench accept --baseline {path} --reason …`"
        ) from None
    except OSError as error:
        raise BaselineError(f"cannot read the baseline {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise BaselineError(f"{path} is not a baseline: no JSON ({error})") from error
    try:
        return _parse(content)
    except BaselineError as error:
        raise BaselineError(f"{path} is not a usable baseline: {error}") from None


def write_baseline(path: Path, baseline: Baseline) -> None:
    """Write a baseline beside its place and rename it: a reader sees the old one or the new one, never a part.

    Raises:
        BaselineError: the folder cannot be written to or is full; an older file is as it was.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, _to_text(baseline).encode())
    except OSError as error:
        raise BaselineError(f"cannot write the baseline {path}: {error.strerror}; it is as it was") from error


def signed_change(accepted: float, value: float, *, floor: float) -> float:
    """Return log10(value / accepted), both at least `floor` [decades]; > 0 is worse, 0 between two infinities."""
    old, new = max(accepted, floor), max(value, floor)
    if old == new:
        return 0.0
    if old == 0.0 or math.isinf(new):
        return math.inf
    return -math.inf if new == 0.0 or math.isinf(old) else math.log10(new) - math.log10(old)


def rounding_floor(contacts: int) -> float:
    """8 eps m: what is below it is rounding; a scene without contacts has the floor of one."""
    return FLOOR_PER_CONTACT * max(contacts, 1)


def _entry(task: TaskRow, rows: Iterable[ScoreRow], *, contacts: int) -> Entry:
    """What one task came to."""
    if task.outcome is None:
        return Entry("not measured", contacts, reason="planned and not done")
    if task.outcome is not Outcome.MEASURED:
        return Entry(task.outcome.value, contacts, reason=task.reason)
    values: dict[str, float] = {}
    for row in rows:
        metric = _metric_of(row)
        if metric and row.verdict is not Verdict.NOT_APPLICABLE:
            # Two residuals of one name (a reference that is given twice): the worse one.
            values[metric] = max(values.get(metric, 0.0), math.inf if math.isnan(row.value) else row.value)
    if task.visits is not None:
        values[WORK] = float(task.visits)
    return Entry(Outcome.MEASURED.value, contacts, values)


def _metric_of(row: ScoreRow) -> str:
    """Name under which a row is gated; empty for all that is not.

    Energy that an inelastic impact loses is no error. Of a solve that was cut off, what a scorecard does not gate is a
    number of some iterate: a bound that is set elsewhere moves it by decades.
    """
    metric = row.metric if row.name == "error" else _METRICS.get((row.name, row.metric), "")
    if row.name == "error" and not metric.startswith(RESIDUAL):
        return ""
    if metric == "energy lost" and not row.gated:
        return ""
    cut_off = row.task.status != Status.CONVERGED.label
    return "" if cut_off and not row.gated and row.name != "termination" else metric


def _compare_pair(pair: Pair, accepted: Entry, now: Entry | None) -> list[Difference]:
    """All numbers of one solver on one scene."""

    def whole(verdict: Change, note: str) -> list[Difference]:
        return [Difference(*pair, "", math.nan, math.nan, math.nan, math.nan, verdict, note)]

    if now is None:
        return whole(Change.MISSING, "the results do not have this solver on this scene")
    if _is_lost(now):
        return whole(Change.MISSING, f"{now.outcome}: {now.reason}" if now.reason else now.outcome)
    if now.contacts != accepted.contacts:
        return whole(Change.MISSING, f"another scene: {accepted.contacts} contacts accepted, {now.contacts} here")
    if now.outcome == Outcome.REFUSED.value:
        was_refused = accepted.outcome == Outcome.REFUSED.value
        return whole(Change.SAME if was_refused else Change.MISSING, f"refused: {now.reason}")
    if accepted.outcome == Outcome.REFUSED.value:
        return whole(Change.NEW, "refused before, measured now")
    names = [*accepted.values, *(metric for metric in now.values if metric not in accepted.values)]
    return [_compare_number(pair, metric, accepted, now) for metric in names]


def _compare_number(pair: Pair, metric: str, accepted: Entry, now: Entry) -> Difference:
    """One number beside the accepted one."""
    floor, allowance = _FLOORS.get(metric, rounding_floor(now.contacts)), ERROR_ALLOWANCE
    if metric == WORK:
        floor, allowance = 0.0, WORK_ALLOWANCE
    old, new = accepted.values.get(metric, math.nan), now.values.get(metric, math.nan)
    if metric not in now.values:
        note = "the number is not there any more"
        return Difference(*pair, metric, old, new, math.nan, allowance, Change.MISSING, note)
    if metric not in accepted.values:
        return Difference(*pair, metric, old, new, math.nan, allowance, Change.NEW)
    change = signed_change(old, new, floor=floor)
    verdict = Change.WORSE if change > allowance else Change.BETTER if change < -allowance else Change.SAME
    return Difference(*pair, metric, old, new, change, allowance, verdict)


def _scope(old: Baseline | None, solvers: Sequence[str] | None) -> tuple[str, ...] | None:
    """Solvers that a new baseline gates: the old one's, and those that were accepted beside them."""
    if old is None:
        return None if solvers is None else tuple(solvers)
    if old.solvers is None or solvers is None:
        return old.solvers
    return tuple(dict.fromkeys((*old.solvers, *solvers)))


def _is_lost(entry: Entry) -> bool:
    """True for a task without an answer and without a refusal."""
    return entry.outcome not in (Outcome.MEASURED.value, Outcome.REFUSED.value)


def _changes(old: Baseline | None, entries: Mapping[Pair, Entry], environment: Mapping[str, object]) -> dict[str, Any]:
    """What a new baseline changes: for each metric the extremes, and every number beyond its allowance."""
    if old is None:
        return {"added": len(entries)}
    comparison = compare(old, entries, environment=environment)
    metrics: dict[str, dict[str, object]] = {}
    for difference in comparison.differences:
        if difference.metric and not math.isnan(difference.change) and difference.change != 0.0:
            summary: dict[str, Any] = metrics.setdefault(difference.metric, {"changed": 0, "largest": 0, "smallest": 0})
            change = _json_number(difference.change)
            summary["changed"] += 1
            summary["largest"] = max(summary["largest"], change, key=float)
            summary["smallest"] = min(summary["smallest"], change, key=float)
    beyond = [
        [difference.solver, difference.scene, difference.metric, _json_number(difference.change)]
        for difference in comparison.differences
        if difference.verdict in (Change.WORSE, Change.BETTER)
    ]
    return {
        "added": len(entries.keys() - old.entries.keys()),
        "removed": sorted(f"{solver} on {scene}" for solver, scene in old.entries.keys() - entries.keys()),
        "decades": metrics,
        "beyond allowance": beyond,
    }


def _rounded(entry: Entry) -> Entry:
    """An entry with as many figures as the file keeps."""
    values = {metric: _short(value) for metric, value in sorted(entry.values.items())}
    return Entry(entry.outcome, entry.contacts, values, entry.reason)


def _short(value: float) -> float:
    """A number with the figures that are kept; counts and infinities as they are."""
    return value if math.isinf(value) or value.is_integer() else float(f"{value:.{KEPT_FIGURES}g}")


def _json_number(value: float) -> float | str:
    """A change as JSON has it, to a thousandth of a decade."""
    return round(value, 3) if math.isfinite(value) else str(value)


def _to_text(baseline: Baseline) -> str:
    """Encode a baseline: one line an entry and one an acceptance, so that a diff shows what changed."""
    head = {
        "schema": SCHEMA_VERSION, "tier": baseline.tier, "seed": baseline.seed,
        "solvers": None if baseline.solvers is None else list(baseline.solvers), "environment": baseline.environment,
    }  # fmt: skip
    lines = [f'"{key}": {_line(value)},' for key, value in head.items()]
    history = ",\n".join(f" {_line(record)}" for record in baseline.history)
    entries = ",\n".join(f" {_line(_row(pair, entry))}" for pair, entry in baseline.entries.items())
    return "\n".join(["{", *lines, '"history": [', history, "],", '"entries": [', entries, "]", "}", ""])


def _row(pair: Pair, entry: Entry) -> dict[str, object]:
    """One entry as it stands in the file."""
    row: dict[str, object] = {
        "solver": pair[0], "scene": pair[1], "contacts": entry.contacts, "outcome": entry.outcome
    }  # fmt: skip
    if entry.reason:
        row["reason"] = entry.reason
    if entry.values:
        row["values"] = {key: _json_value(value) for key, value in entry.values.items()}
    return row


def _json_value(value: float) -> float | int | str:
    """A value as JSON has it: whole numbers without a point, infinity as a word."""
    if math.isinf(value):
        return str(value)
    return int(value) if value.is_integer() else value


def _line(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _parse(content: object) -> Baseline:
    """Check a decoded file field by field."""
    if not isinstance(content, Mapping):
        raise BaselineError("the file must hold a JSON object")
    schema = content.get("schema")
    if schema != SCHEMA_VERSION:
        raise BaselineError(
            f"schema version {schema}, and this impactbench reads {SCHEMA_VERSION}: use the version that wrote it, or "
            "accept a new baseline into another file"
        )
    tier = _known_tier(_field(content, "tier", str))
    seed = _field(content, "seed", int)
    solvers = content.get("solvers")
    if solvers is not None and not (isinstance(solvers, list) and solvers and all(isinstance(s, str) for s in solvers)):
        raise BaselineError("solvers must be null or a list of names")
    rows = _field(content, "entries", list)
    if not rows:
        raise BaselineError("it has no entries")
    entries: dict[Pair, Entry] = {}
    for number, row in enumerate(rows):
        pair, entry = _parse_row(row, number)
        if pair in entries:
            raise BaselineError(f"{pair[0]} on {pair[1]} is there twice")
        entries[pair] = entry
    history = _field(content, "history", list)
    if not all(isinstance(record, Mapping) for record in history):
        raise BaselineError("history must hold objects")
    environment = _field(content, "environment", dict)
    return Baseline(tier, seed, None if solvers is None else tuple(solvers), environment, entries, tuple(history))


def _parse_row(row: object, number: int) -> tuple[Pair, Entry]:
    """Check one entry."""
    if not isinstance(row, Mapping):
        raise BaselineError(f"entry {number} must be an object")
    try:
        solver, scene = _field(row, "solver", str), _field(row, "scene", str)
        contacts, outcome = _field(row, "contacts", int), _field(row, "outcome", str)
        if outcome not in (Outcome.MEASURED.value, Outcome.REFUSED.value):
            raise BaselineError(f"outcome must be measured or refused, not {outcome!r}")
        if contacts < 0:
            raise BaselineError(f"contacts must be ≥ 0, not {contacts}")
        given = _field(row, "values", dict) if outcome == Outcome.MEASURED.value else {}
        if outcome == Outcome.MEASURED.value and not given:
            raise BaselineError("it is measured and has no values")
        values = {_known_metric(metric): _value(metric, value) for metric, value in given.items()}
    except BaselineError as error:
        raise BaselineError(f"entry {number}: {error}") from None
    return (solver, scene), Entry(outcome, contacts, values, str(row.get("reason", "")))


def _field(row: Mapping[str, Any], name: str, kind: type[Any]) -> Any:
    """One field of the type that it must have."""
    if name not in row:
        raise BaselineError(f"{name} is missing")
    value = row[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BaselineError(f"{name} must be of type {kind.__name__}, not {value!r}")
    return value


def _value(metric: str, value: object) -> float:
    """A number ≥ 0, or "inf"."""
    number = math.inf if value == "inf" else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not number >= 0:
        raise BaselineError(f"{metric} must be a number ≥ 0, not {value!r}")
    return float(number)


def _known_metric(metric: str) -> str:
    if metric not in METRICS and not metric.startswith(RESIDUAL):
        raise BaselineError(unknown("metric", metric, (*METRICS, f"{RESIDUAL}…")))
    return metric


def _known_tier(tier: str) -> str:
    if tier not in TIERS:
        raise BaselineError(unknown("tier", tier, TIERS))
    return tier


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of a baseline")


def _task_seeds(store: Frames) -> dict[str, int]:
    """Row of a task → its seed; tasks of an older plan in the same folder may have another one."""
    frame = store.frame("tasks")
    return {str(task): int(seed) for task, seed in zip(frame["task"], frame["seed"], strict=True)}


def _sortable(change: float) -> float:
    """Missing first, then the largest change."""
    return math.inf if math.isnan(change) else change
