"""Plan and run: which solvers meet which scenes, in what order, and how far the run is.

The plan is stored before anything is measured: what never ran stays visible as planned, so that a run which measured
nothing cannot pass for one that found nothing wrong. A run that was killed goes on with what is still planned.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.environment import describe_environment
from harness.isolation import Limits, run_isolated
from harness.measurement import Kind, Outcome, Task
from harness.selection import ScenarioChoice, SelectionError, SolverChoice, build_scenario, unknown
from harness.store import Ending, PlannedTask, Store
from harness.sweeps import SWEEPS
from scenarios import CATALOG
from scenarios.scenario import Scenario
from scenarios.tiers import HARD, TIERS

# What makes numbers incomparable, of all that the environment says: code, arithmetic, and the machine for times.
COMPARED = ("impactbench", "source", "python", "numpy", "scipy", "numba", "cpu")
# Outcomes by which a run has failed: a refusal is an answer, these are not.
FAILURES = (Outcome.RAISED, Outcome.INVALID, Outcome.CRASHED, Outcome.TIMED_OUT, Outcome.OUT_OF_MEMORY)


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    total: int
    """Tasks of the plan."""
    done: int
    """Of these done, now or by an earlier run."""
    failures: int
    """Tasks that this run lost: crashed, timed out, raised, invalid, out of memory."""
    elapsed_s: float
    in_hand: tuple[str, ...] = ()
    """Tasks that run now, as "solver on scene"."""
    ended: PlannedTask | None = None
    """The task that has just ended, with `ending`; None between."""
    ending: Ending | None = None


@dataclass(frozen=True)
class Summary:
    """What the tasks of a plan came to."""

    outcomes: Mapping[Outcome, int]
    """How many tasks ended how, the most frequent first."""
    lost: tuple[str, ...]
    """Tasks that ended without an answer, each with its outcome and reason."""


def plan_tasks(
    solvers: Sequence[SolverChoice], *, tier: str, scenarios: Sequence[ScenarioChoice] = (), seed: int = 0
) -> list[PlannedTask]:
    """List every task of a tier: each sweep and each scene with each solver. The hard cases come without sweeps.

    Args:
        solvers: who takes part.
        tier: name in `TIERS`.
        scenarios: only these families or members, and only these sweeps; empty for all of the tier.
        seed: base seed; each task's own is derived from it and the scene, so that all solvers meet the same
            disturbances and the order of tasks does not matter.

    Raises:
        SelectionError: there is no such tier.
    """
    if tier not in TIERS:
        raise SelectionError(unknown("tier", tier, TIERS))
    kind, sweeps = (Kind.HARD_CASE, ()) if tier == HARD else (Kind.IMPACT, tuple(SWEEPS))
    # Sweeps take longest and go first: at the end no core waits for one of them.
    planned = [
        PlannedTask(_task(Kind.SWEEP, solver, name, {}, seed), solver.settings, name)
        for name in SWEEPS
        if any(choice.name == name for choice in scenarios) or (not scenarios and name in sweeps)
        for solver in solvers
    ]
    for scene in _chosen_scenes(tier, scenarios):
        planned += [
            PlannedTask(
                _task(kind, solver, scene.name, scene.parameters, seed), solver.settings, scene.label, scene.tags
            )
            for solver in solvers
        ]
    return planned


def fingerprint(*, seed: int, limits: Limits, environment: Mapping[str, object]) -> dict[str, object]:
    """Collect all that makes results incomparable where it differs; the store refuses to mix them."""
    return {
        **{key: environment[key] for key in COMPARED},
        "seed": seed,
        "timeout_s": limits.timeout_s,
        "memory_mb": limits.memory_mb,
    }


def measure(
    folder: Path,
    plan: Sequence[PlannedTask],
    *,
    seed: int,
    jobs: int,
    limits: Limits,
    command: str,
    tier: str,
    on_progress: Callable[[Progress], None],
    retry: bool = False,
) -> Summary:
    """Store a plan and measure all that is not done yet, in child processes.

    Args:
        folder: results folder.
        plan: the tasks; those that the store has done already are skipped.
        seed: base seed of the plan, for the fingerprint.
        jobs: worker processes.
        limits: of each task.
        command: as it was called, for the record.
        tier: name of the tier that the plan comes from, for the record.
        on_progress: called at the start, whenever a task ended, and a few times a second between.
        retry: measure those again that an earlier run lost (`FAILURES`).

    Returns:
        What the tasks of the plan came to, now or by an earlier run.

    Raises:
        StoreError: the folder cannot be used, or holds incomparable results.
        IsolationError: child processes cannot be started.
        KeyboardInterrupt: all that ended before is stored; the same call goes on.
    """
    environment = describe_environment()
    with Store.create_or_open(folder, fingerprint(seed=seed, limits=limits, environment=environment)) as store:
        run = store.begin_run(
            version=str(environment["impactbench"]),
            environment=environment,
            settings={
                "tier": tier,
                "seed": seed,
                "jobs": jobs,
                "timeout_s": limits.timeout_s,
                "memory_mb": limits.memory_mb,
            },
            command=command,
        )
        rows = store.plan(plan, run=run)
        if retry:
            store.plan_again(rows, FAILURES)
        _run_pending(store, rows, run, jobs=jobs, limits=limits, on_progress=on_progress)
        store.finish_run(run)
        return _summary(store, rows)


def describe(planned: PlannedTask) -> str:
    """Name a task as progress shows it."""
    return f"{planned.task.solver} on {planned.label}"


def task_seed(base: int, kind: Kind, scenario: str, parameters: Mapping[str, object]) -> int:
    """Derive a task's seed from what it does, not from when it runs; the same for every solver."""
    content = json.dumps([base, kind.value, scenario, parameters], sort_keys=True, default=list)
    # 31 bits: fits every generator and SQLite's integers.
    return int.from_bytes(hashlib.sha256(content.encode()).digest()[:4], "big") >> 1


def _run_pending(
    store: Store,
    rows: Sequence[int],
    run: int,
    *,
    jobs: int,
    limits: Limits,
    on_progress: Callable[[Progress], None],
) -> None:
    """Run what is still planned of these rows, store each ending as it comes, and tell how far it is."""
    begin = time.monotonic()
    wanted = set(rows)
    # Rows that another plan left open stay so: this command did not ask for them.
    pending = [planned for planned in store.pending() if planned.number in wanted]
    total = len(wanted)
    done = total - len(pending)
    failures = 0

    def state(
        in_hand: Iterable[PlannedTask] = (), ended: PlannedTask | None = None, ending: Ending | None = None
    ) -> Progress:
        names = tuple(describe(planned) for planned in in_hand)
        return Progress(total, done, failures, time.monotonic() - begin, names, ended, ending)

    def on_end(planned: PlannedTask, ending: Ending) -> None:
        nonlocal done, failures
        store.record(planned.number, ending, run=run)
        done += 1
        failures += ending.outcome in FAILURES
        on_progress(state(ended=planned, ending=ending))

    on_progress(state())
    run_isolated(pending, jobs=jobs, limits=limits, on_end=on_end, on_poll=lambda in_hand: on_progress(state(in_hand)))


def _summary(store: Store, rows: Sequence[int]) -> Summary:
    """Add up what the rows of a plan came to."""
    tasks = store.frame("tasks")
    tasks = tasks[tasks["task"].isin(rows)]
    outcomes = Counter(Outcome(outcome) for outcome in tasks["outcome"])
    lost = tasks[tasks["outcome"].isin([outcome.value for outcome in FAILURES])]
    lines = tuple(f"{row.solver} on {row.label}: {row.outcome}: {row.reason}" for row in lost.itertuples())
    return Summary(dict(outcomes.most_common()), lines)


def _chosen_scenes(tier: str, scenarios: Sequence[ScenarioChoice]) -> list[Scenario]:
    """The scenes of the tier, or those that were asked for; none twice."""
    chosen: list[tuple[str, Mapping[str, object]]] = [] if scenarios else list(TIERS[tier])
    for choice in scenarios:
        members = [(name, parameters) for name, parameters in TIERS[tier] if name == choice.name]
        if choice.name in CATALOG:
            chosen += [(choice.name, choice.parameters)] if choice.exact or not members else members
    scenes = (build_scenario(name, parameters) for name, parameters in chosen)
    return list({scene.label: scene for scene in scenes}.values())


def _task(kind: Kind, solver: SolverChoice, scenario: str, parameters: Mapping[str, object], seed: int) -> Task:
    return Task(kind, solver.specification, scenario, parameters, task_seed(seed, kind, scenario, parameters))
