"""Speed against error: what a solver's accuracy costs, how the cost grows, where it breaks. Plan and run.

Five kinds of task, each one solver at one setting on one scene in a child process, stored like a sweep:

    errors    one solve and its errors, verification and validation apart; never timed
    times     repeated solves, never looked at; one task a round, so that repeats of all solvers alternate
    scaling   times with default settings over the number of contacts, and memory
    cold      the first solve in a fresh process
    warm      steps of a layer at rest, each from zero and from the impulse of the step before

The work of a setting is its time, and its contact visits, which no machine changes. What failed in one task is not run
again in its later rounds or at larger sizes: those rows carry the same outcome and say so.
"""

from __future__ import annotations

import functools
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from harness import accuracy, desiderata
from harness.checked import checked_solve, ratio, remaining_approach
from harness.environment import describe_environment
from harness.isolation import Limits, run_isolated
from harness.measure import registry_name
from harness.measurement import Kind, Measurement, Outcome, Score, Series, Task, not_applicable, shown
from harness.run import FAILURES, Progress, Summary, fingerprint
from harness.selection import (
    ScenarioChoice,
    SelectionError,
    SolverChoice,
    available_solvers,
    build_scenario,
    choose_scenarios,
    choose_solver,
    setting_fields,
    unknown,
)
from harness.statistics import summarize
from harness.store import Ending, PlannedTask, Store
from harness.timing import Timing, time_first_solves, time_solver
from harness.warm_start import measure_warm_start, takes_start
from scenarios.scenario import Scenario
from solvers import ImpactProblem, ImpactSolution, Solver
from solvers.solution import Floats

Scenes: TypeAlias = tuple[tuple[str, dict[str, object]], ...]

ERRORS, TIMES, SCALING, COLD, WARM = "errors", "times", "scaling", "cold", "warm"
RUNS = (ERRORS, TIMES, SCALING, COLD, WARM)
"""Names of the tasks, in the order in which they run."""
# How the reason of a task begins that took over the ending of another one.
PASSED_OVER = "not run again"
# The compliant reference of a larger pack takes minutes and ends at its bound on contact visits.
LARGEST_REFERENCED = 8000

# Metrics of an error run; the figures and tables ask for them by name.
OWN_EQUATIONS = "own equations"
"""Residual of the equations that the law says it solves, recomputed here."""
OWN_LIMIT = "own limit"
"""Distance to the law's own answer at its finest setting, ‖v - v_finest‖∞ over max|v_pre|."""
APPROACH = "remaining approach"
"""Fastest approach that is left, over the largest |u_pre|."""
ENERGY = "energy"
MOMENTUM = "momentum"
VERIFICATION = "verification"
"""Own equations, with the remaining approach where they are silent of it; own limit where none are checked."""


@dataclass(frozen=True)
class Dial:
    """The setting of a solver that trades time for accuracy."""

    factors: Mapping[str, float]
    """Field → what the dial's value is multiplied with for it; the first is the one that is named."""
    values: tuple[float, ...]
    """From coarse to fine."""
    fewest: int = 0
    """Contacts from which on the dial does anything."""
    most: float = math.inf
    """Contacts up to which it does."""
    paired: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Field → its value beside each of `values`, where the two belong together."""

    @property
    def field(self) -> str:
        """Name of the setting."""
        return next(iter(self.factors))


TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
FINE_TOLERANCES = (*TOLERANCES, 1e-12)
PASSES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 10_000.0)
STEPS = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
# `solvers.compression` integrates adaptively up to so many contacts, with fixed steps above.
ADAPTIVE_CONTACTS = 200

_TOLERANCE = Dial({"tolerance": 1.0}, TOLERANCES)
_FINE_TOLERANCE = Dial({"tolerance": 1.0}, FINE_TOLERANCES)
_COMPLIANT = (
    Dial({"tolerance": 1.0}, (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12), most=ADAPTIVE_CONTACTS),
    Dial({"steps_per_contact": 1.0}, STEPS, fewest=ADAPTIVE_CONTACTS + 1),
)

DIALS: dict[str, tuple[Dial, ...]] = {
    # Coarse steps and a short memory of gaps save time together: the pairs are the cheapest of each error (measured).
    "ehi": (
        Dial(
            {"steps_per_contact": 1.0},
            (1.75, 2.0, 2.5, 3.0, 4.0, 8.0, 16.0, 32.0, 64.0),
            paired={"gap_memory": (0.3, 0.2, 0.1, 0.05, 0.03, 0.01, 0.003, 0.001, 0.0)},
        ),
    ),
    "gauss-seidel": (Dial({"max_iterations": 1.0}, PASSES),),
    # The inner LCP must be tighter than the outer test, or packs come out up to 10 % wrong.
    "gr": (Dial({"tolerance": 1.0, "inner_tolerance": 1e-3}, TOLERANCES),),
    "hertz": _COMPLIANT,
    "jacobi": (Dial({"max_iterations": 1.0}, PASSES),),
    "lcp-apgd": (_FINE_TOLERANCE,),
    # `tolerance` judges what comes back: how long a package works is said by its own.
    "lcp-clarabel": (Dial({"solver_tolerance": 1.0}, FINE_TOLERANCES),),
    "lcp-osqp": (Dial({"solver_tolerance": 1.0}, TOLERANCES),),
    "lcp-pgs": (_FINE_TOLERANCE,),
    "lcp-spg": (_FINE_TOLERANCE,),
    "lzb": _COMPLIANT,
    "qce": (_FINE_TOLERANCE,),
    "qce-blend": (Dial({"tolerance": 1.0, "qce_tolerance": 1.0}, TOLERANCES),),
    "qce-defer": (_FINE_TOLERANCE,),
    "qce-lcp": (Dial({"tolerance": 1.0, "qce_tolerance": 1.0}, TOLERANCES),),
}
"""Solver → the settings that are swept. A solver that is not here has no such setting, or a field `tolerance`."""


@dataclass(frozen=True)
class Extent:
    """How much of everything a bench measures."""

    scenes: Scenes
    """Work-precision scenes: family and parameters."""
    pack_sizes: tuple[int, ...]
    """Spheres of the scaling packs."""
    chain_sizes: tuple[int, ...]
    """Balls of the scaling chains."""
    resting: int
    """Spheres of the layer that rests, for the warm start."""
    repeats: int


_CHAIN: tuple[str, dict[str, object]] = ("three-ball-chain", {"va": 0.5})
_SMALL_PACK: tuple[str, dict[str, object]] = ("sphere-pack", {"spheres": 100, "start": "hot"})
_RESTING: dict[str, object] = {"restitution": 0.0}
_SINGLE: Scenes = (_CHAIN, ("newtons-cradle", {"balls": 5}), ("pool-break", {}), ("box-on-floor", {"points": 9}))


def _packs(*sizes: int) -> Scenes:
    """Packs of these sizes, with both starts."""
    return tuple(("sphere-pack", {"spheres": size, "start": start}) for size in sizes for start in ("kick", "hot"))


TIERS: dict[str, Extent] = {
    "smoke": Extent((_CHAIN, _SMALL_PACK), (100, 200, 400), (11, 31, 101), 100, 2),
    "default": Extent((*_SINGLE, *_packs(300, 1000)), (300, 1000, 2000, 4000), (11, 101, 301, 1001), 300, 3),
    "full": Extent(
        (*_SINGLE, *_packs(300, 1000, 4000)), (300, 1000, 4000, 15_000, 60_000), (11, 101, 301, 1001, 10_001), 1000, 7
    ),
}
"""Tier → what a bench measures: seconds, minutes, a night."""


def plan_bench(
    solvers: Sequence[SolverChoice],
    *,
    tier: str = "default",
    scenarios: Sequence[ScenarioChoice] = (),
    sizes: Sequence[int] = (),
    repeats: int | None = None,
    seed: int = 0,
) -> list[PlannedTask]:
    """List every task of a bench.

    Args:
        solvers: who takes part. One that is named with its accuracy setting keeps it; all others are swept.
        tier: name in `TIERS`.
        scenarios: only these families or members; empty for all of the tier. Scaling is measured of the families
            "sphere-pack" and "newtons-cradle" where they are among them.
        sizes: spheres of the scaling packs; empty for those of the tier.
        repeats: rounds of timing; None for those of the tier.
        seed: of the packs.

    Raises:
        SelectionError: no such tier, a size or the repeats are not positive, or a family refuses its parameters.
    """
    extent = _extent(tier, sizes, repeats)
    planned: list[PlannedTask] = []
    for name, parameters in _chosen(extent, scenarios, seed):
        scene = build_scenario(name, parameters)
        points = [point for choice in solvers for point in _points(choice, scene.problem.m)]
        planned += [_planned(ERRORS, point, scene, seed) for point in points]
        planned += [_planned(TIMES, point, scene, seed, round=k) for k in range(extent.repeats) for point in points]
    families = {choice.name for choice in scenarios}
    plain = [_Point(choice, choice.specification, "", math.nan, "") for choice in solvers]
    for scene in _scaling_scenes(extent, families, seed):
        planned += [_planned(SCALING, point, scene, seed, round=k) for k in range(extent.repeats) for point in plain]
    if not scenarios:
        scene = build_scenario(*_CHAIN)
        planned += [_planned(COLD, point, scene, seed, round=k) for k in range(extent.repeats) for point in plain]
        layer = build_scenario("sphere-pack", _seeded("sphere-pack", {"spheres": extent.resting, **_RESTING}, seed))
        started = [point for point in plain if takes_start(point.law.solver)]
        planned += [_planned(WARM, point, layer, seed, round=k) for k in range(extent.repeats) for point in started]
    if not planned:
        raise SelectionError("nothing to measure: no scene was chosen")
    return planned


def choose_bench(
    solvers: Iterable[str] = (), scenarios: Iterable[str] = ()
) -> tuple[list[SolverChoice], list[ScenarioChoice]]:
    """Turn the user's names into choices; no solver named means all.

    Raises:
        SelectionError: a name or a setting does not exist; the text has the near ones.
    """
    chosen = {
        choice.specification: choice
        for choice in (choose_solver(name) for name in tuple(solvers) or available_solvers())
    }
    return list(chosen.values()), [choice for name in scenarios for choice in choose_scenarios(name)]


def run_bench(
    folder: Path,
    plan: Sequence[PlannedTask],
    *,
    seed: int,
    jobs: int = 1,
    limits: Limits,
    command: str,
    on_progress: Callable[[Progress], None],
    retry: bool = False,
) -> Summary:
    """Store a plan and measure all that is not done yet: errors first, then the rounds of times.

    Args:
        folder: results folder of its own; a scorecard's is refused.
        plan: from `plan_bench`.
        seed: of the plan.
        jobs: child processes of the error runs; times are taken one at a time.
        limits: of each task.
        command: as it was called, for the record.
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
    comparable = {**fingerprint(seed=seed, limits=limits, environment=environment), "results of": "bench"}
    with Store.create_or_open(folder, comparable) as store:
        run = store.begin_run(
            version=str(environment["impactbench"]),
            environment=environment,
            settings={"seed": seed, "jobs": jobs, "timeout_s": limits.timeout_s, "memory_mb": limits.memory_mb},
            command=command,
        )
        rows = set(store.plan(plan, run=run))
        if retry:
            store.plan_again(rows, FAILURES)
        # Rows that another plan left open stay so: this command did not ask for them.
        pending = [planned for planned in store.pending() if planned.number in rows]
        runner = _Runner(store, run, limits, on_progress, total=len(rows), done=len(rows) - len(pending))
        for stage, stage_tasks in _stages(pending):
            runner.run(stage_tasks, jobs=jobs if stage == ERRORS else 1)
        store.finish_run(run)
        tasks = store.frame("tasks")
        return _summary(tasks[tasks["task"].isin(rows)].itertuples())


def measure_bench(task: Task) -> Measurement:
    """Measure one task of a bench, in the process that runs it.

    Raises:
        Exception: whatever the solver raises.
    """
    solver = choose_solver(task.solver).solver
    parameters = task.parameters
    name, texts = str(parameters["scene"]), json.dumps(parameters["parameters"], sort_keys=True)
    scene = _scene(name, texts)
    if task.scenario == ERRORS:
        finest = str(parameters["finest"])
        # The finest setting is the yardstick of its own law: it has no distance to itself.
        measured_by = _velocity(finest, name, texts) if finest not in ("", task.solver) else None
        return measure_errors(solver, scene, limit=measured_by)
    if task.scenario == COLD:
        return _measure_cold(solver, scene)
    if task.scenario == WARM:
        return _measure_warm(solver, scene, task.seed)
    return _timing_measurement(time_solver(solver, scene.problem), scene.problem)


def measure_errors(solver: Solver, scene: Scenario, *, limit: Floats | None = None) -> Measurement:
    """Solve once and measure all errors, verification and validation apart.

    Args:
        solver: the law at one setting.
        scene: the scene.
        limit: velocity after the impact by the same law at its finest setting, shape (n,); None where it has none.

    Raises:
        UnsupportedProblem: the law does not apply.
        InvalidSolution: the answer breaks the contract.
    """
    problem = scene.problem
    solution = checked_solve(solver, problem)
    own = _own_equations(solver, problem, solution)
    distance = math.nan if limit is None else _distance(problem, solution.v_post, limit)
    approach = remaining_approach(problem, solution.v_post)
    scores = [
        _error(OWN_EQUATIONS, own),
        _error(OWN_LIMIT, distance),
        _error(APPROACH, approach),
        _energy(problem, solution.v_post),
        _error(MOMENTUM, desiderata.mom(problem, solution.v_post, scene.invariants).value),
        _error(VERIFICATION, _verification(solver, own, distance, approach)),
    ]
    if problem.m <= LARGEST_REFERENCED:
        scores += accuracy.validation(problem, solution.v_post, scene.references)
    return Measurement(solution.status.label, int(solution.iterations), int(solution.visits), tuple(scores))


@dataclass(frozen=True)
class _Point:
    """A solver at one setting of its dial."""

    law: SolverChoice
    specification: str
    field: str
    """Name of the dial; empty where the solver has none."""
    value: float
    finest: str
    """Specification of the finest setting."""


def _extent(tier: str, sizes: Sequence[int], repeats: int | None) -> Extent:
    """The tier's extent with what the user changed."""
    if tier not in TIERS:
        raise SelectionError(unknown("tier", tier, TIERS))
    for size in sizes:
        if size <= 0:
            raise SelectionError(f"sizes must be positive, not {size}")
    if repeats is not None and repeats <= 0:
        raise SelectionError(f"repeats must be positive, not {repeats}")
    extent = TIERS[tier]
    return replace(extent, pack_sizes=tuple(sorted(set(sizes))) or extent.pack_sizes, repeats=repeats or extent.repeats)


def _chosen(extent: Extent, scenarios: Sequence[ScenarioChoice], seed: int) -> list[tuple[str, Mapping[str, object]]]:
    """The tier's scenes, or those that were asked for; none twice."""
    chosen: list[tuple[str, Mapping[str, object]]] = [] if scenarios else list(extent.scenes)
    for choice in scenarios:
        members = [(name, parameters) for name, parameters in extent.scenes if name == choice.name]
        chosen += [(choice.name, choice.parameters)] if choice.exact or not members else members
    seeded = [(name, _seeded(name, parameters, seed)) for name, parameters in chosen]
    return list({json.dumps(scene, sort_keys=True, default=list): scene for scene in seeded}.values())


def _seeded(name: str, parameters: Mapping[str, object], seed: int) -> Mapping[str, object]:
    """Give a random scene the seed of the run, unless it was named with its own."""
    return {"seed": seed, **parameters} if name == "sphere-pack" and seed else parameters


def _points(choice: SolverChoice, contacts: int) -> list[_Point]:
    """A solver at all settings of its dial that does something with so many contacts."""
    swept = DIALS.get(
        choice.name, (_TOLERANCE,) if "tolerance" in choice.settings and choice.name not in _EXACT else ()
    )
    for dial in swept:
        given = choice.specification.removeprefix(choice.name)
        fields = setting_fields(type(choice.solver))
        if not dial.fewest <= contacts <= dial.most or f"{dial.field}=" in given or dial.field not in fields:
            continue
        made = [(value, _at(choice, dial, value)) for value in dial.values]
        return [_Point(choice, text, dial.field, value, made[-1][1]) for value, text in made]
    return [_Point(choice, choice.specification, "", math.nan, "")]


_EXACT = ("lcp-nnls",)
"""Solvers whose tolerance is a check of the answer and changes nothing of it."""


def _at(choice: SolverChoice, dial: Dial, value: float) -> str:
    """Specification of a solver at one setting of a dial."""
    default = setting_fields(type(choice.solver))
    settings = {
        field: round(value * factor) if isinstance(default[field], int) else _short(value * factor)
        for field, factor in dial.factors.items()
        if field in default
    }
    settings |= {field: values[dial.values.index(value)] for field, values in dial.paired.items() if field in default}
    text = ",".join(f"{field}={setting!r}" for field, setting in settings.items())
    separator = ":" if choice.specification == choice.name else ","
    return choose_solver(f"{choice.specification}{separator}{text}").specification


def _short(value: float) -> float:
    """A number without the rounding of a product: 1e-7, not 1.0000000000000001e-7."""
    return float(f"{value:.6g}")


def _planned(run: str, point: _Point, scene: Scenario, seed: int, **more: object) -> PlannedTask:
    """One task; its parameters say all that a report needs, even where the task is lost."""
    parameters: dict[str, object] = {
        "scene": scene.name,
        "parameters": dict(scene.parameters),
        "law": point.law.specification,
        "field": point.field,
        "value": None if math.isnan(point.value) else point.value,
        "contacts": scene.problem.m,
        **({"finest": point.finest} if run == ERRORS else {}),
        **more,
    }
    settings = choose_solver(point.specification).settings
    task = Task(Kind.SWEEP, point.specification, run, parameters, seed)
    return PlannedTask(task, settings, scene.label, scene.tags)


def _scaling_scenes(extent: Extent, families: set[str], seed: int) -> Iterable[Scenario]:
    """Packs and chains of growing size."""
    if not families or "sphere-pack" in families:
        for name, parameters in _packs(*extent.pack_sizes):
            yield build_scenario(name, _seeded(name, parameters, seed))
    if not families or "newtons-cradle" in families:
        for balls in extent.chain_sizes:
            yield build_scenario("newtons-cradle", {"balls": balls})


def _stages(pending: Sequence[PlannedTask]) -> Iterable[tuple[str, list[PlannedTask]]]:
    """What is run together: errors, the rounds of times and of scaling, and every cold task by itself.

    A round holds all solvers, so that repeats of one are taken over the whole time of the run. The first round of
    scaling goes size by size: who fails is not tried on larger ones.
    """

    def stage(planned: PlannedTask) -> tuple[int, int, int]:
        parameters = planned.task.parameters
        kind = RUNS.index(planned.task.scenario)
        if planned.task.scenario == COLD:
            return kind, planned.number, 0
        first = _count(parameters.get("round", 0)) == 0
        size = _count(parameters["contacts"]) if planned.task.scenario == SCALING and first else 0
        return kind, 0 if first else 1, size

    stages: dict[tuple[int, int, int], list[PlannedTask]] = {}
    for planned in pending:
        stages.setdefault(stage(planned), []).append(planned)
    for key in sorted(stages):
        in_rounds = sorted(stages[key], key=lambda planned: _count(planned.task.parameters.get("round", 0)))
        yield in_rounds[0].task.scenario, in_rounds


def _summary(rows: Iterable[Any]) -> Summary:
    """Add up what some rows of tasks came to; what was passed over is not said twice."""
    counts: Counter[Outcome] = Counter()
    lines = []
    for row in rows:
        outcome = Outcome(row.outcome)
        counts[outcome] += 1
        if outcome in FAILURES and not row.reason.startswith(PASSED_OVER):
            lines.append(f"{row.scenario}: {row.solver} on {row.label}: {outcome.value}: {row.reason}")
    return Summary(dict(counts.most_common()), tuple(lines))


class _Runner:
    """Runs stages, stores every ending as it comes, and passes over what failed before."""

    def __init__(
        self, store: Store, run: int, limits: Limits, on_progress: Callable[[Progress], None], *, total: int, done: int
    ) -> None:
        self._store, self._run, self._limits, self._on_progress = store, run, limits, on_progress
        self._begin = time.monotonic()
        self._total, self._done = total, done
        self._failures = 0
        self._lost = _Lost(store)
        on_progress(self._state())

    def run(self, tasks: Sequence[PlannedTask], *, jobs: int) -> None:
        """Run one stage in child processes."""
        open_tasks = []
        for planned in tasks:
            ending = self._lost.ending_of(planned)
            if ending is None:
                open_tasks.append(planned)
            else:
                self._end(planned, ending)
        if open_tasks:
            run_isolated(
                open_tasks, jobs=jobs, limits=self._limits, on_end=self._end,
                on_poll=lambda in_hand: self._on_progress(self._state(in_hand)), measure=measure_bench,
            )  # fmt: skip

    def _end(self, planned: PlannedTask, ending: Ending) -> None:
        self._store.record(planned.number, ending, run=self._run)
        self._lost.note(planned.task.scenario, planned.task, ending.outcome, ending.reason)
        self._done += 1
        self._failures += ending.outcome in FAILURES
        self._on_progress(self._state(ended=planned, ending=ending))

    def _state(
        self, in_hand: Iterable[PlannedTask] = (), ended: PlannedTask | None = None, ending: Ending | None = None
    ) -> Progress:
        names = tuple(f"{planned.task.scenario}: {planned.task.solver} on {planned.label}" for planned in in_hand)
        elapsed = time.monotonic() - self._begin
        return Progress(self._total, self._done, self._failures, elapsed, names, ended, ending)


class _Lost:
    """What ended without an answer, and what need not be tried for that reason."""

    def __init__(self, store: Store) -> None:
        self._points: dict[tuple[str, str], tuple[Outcome, str]] = {}
        self._sizes: dict[tuple[str, str], tuple[int, Outcome, str]] = {}
        for row in store.frame("tasks").itertuples():
            if row.state == "done":
                task = Task(Kind(row.kind), row.solver, row.scenario, row.parameters, int(row.seed))
                self.note(row.scenario, task, Outcome(row.outcome), row.reason)

    def note(self, run: str, task: Task, outcome: Outcome, reason: str) -> None:
        """Remember an ending; a reason that was itself taken over stays the first one."""
        if outcome is Outcome.MEASURED:
            return
        self._points.setdefault((task.solver, _scene_key(task)), (outcome, reason))
        if run == SCALING and outcome in (Outcome.TIMED_OUT, Outcome.OUT_OF_MEMORY):
            size = _count(task.parameters["contacts"])
            known = self._sizes.get((task.solver, _family_key(task)))
            if known is None or size < known[0]:
                self._sizes[task.solver, _family_key(task)] = (size, outcome, reason)

    def ending_of(self, planned: PlannedTask) -> Ending | None:
        """Return the ending that a task takes over, or None where it is to be run."""
        task = planned.task
        before = self._points.get((task.solver, _scene_key(task)))
        if before is not None:
            return Ending(before[0], _taken_over(before[1], "this scene"))
        smaller = self._sizes.get((task.solver, _family_key(task)))
        if task.scenario == SCALING and smaller and smaller[0] < _count(task.parameters["contacts"]):
            return Ending(smaller[1], _taken_over(smaller[2], f"{smaller[0]} contacts"))
        return None


def _taken_over(reason: str, where: str) -> str:
    return reason if reason.startswith(PASSED_OVER) else f"{PASSED_OVER} after its end on {where}: {reason}"


def _scene_key(task: Task) -> str:
    return json.dumps([task.parameters["scene"], task.parameters["parameters"]], sort_keys=True, default=list)


def _family_key(task: Task) -> str:
    """The scene without its size."""
    parameters = task.parameters["parameters"]
    assert isinstance(parameters, Mapping)
    kept = {key: value for key, value in parameters.items() if key not in ("spheres", "balls")}
    return json.dumps([task.parameters["scene"], kept], sort_keys=True, default=list)


@functools.lru_cache(maxsize=2)
def _scene(name: str, parameters: str) -> Scenario:
    """A scene, kept in the worker with its references: the next task is most often on the same one."""
    return build_scenario(name, json.loads(parameters))


@functools.lru_cache(maxsize=64)
def _velocity(specification: str, scene: str, parameters: str) -> Floats:
    """The answer of a law to a scene, kept in the worker: all settings of the law are compared with it."""
    return checked_solve(choose_solver(specification).solver, _scene(scene, parameters).problem).v_post


def _verification(solver: Solver, own: float, distance: float, approach: float) -> float:
    """One number for how well a law solves its own equations; NaN where nothing tells.

    Energy says nothing of what still approaches, so both count. The residual of an LCP holds its own condition on u,
    which is not u ≥ 0: with restitution 1 what separates before may approach after.
    """
    if math.isnan(own):
        return distance
    return max(own, approach) if accuracy.OWN_EQUATIONS[registry_name(solver)] is accuracy.energy else own


def _own_equations(solver: Solver, problem: ImpactProblem, solution: ImpactSolution) -> float:
    """Residual of the law's own equations; NaN where it has none that are checked.

    The estimate by a looser tolerance, which compliant laws have there, is no residual: `OWN_LIMIT` does it for all.
    """
    check = accuracy.OWN_EQUATIONS.get(registry_name(solver))
    if check is None or check is accuracy.self_convergence:
        return math.nan
    return check(solver, problem, solution).value


def _distance(problem: ImpactProblem, v_post: Floats, limit: Floats) -> float:
    """Largest |v - v_limit| over the largest |v_pre|, dimensionless."""
    return ratio(float(np.abs(v_post - limit).max(initial=0.0)), float(np.abs(problem.v_pre).max(initial=0.0)))


def _energy(problem: ImpactProblem, v_post: Floats) -> Score:
    """The energy error |K⁺ - K⁻| / K⁻ of an elastic, frictionless impact."""
    for score in desiderata.kin(problem, v_post):
        if score.metric == "energy error e":
            return _error(ENERGY, score.value)
    return not_applicable("error", ENERGY, "the energy after the impact is not known")


def _error(metric: str, value: float) -> Score:
    """An error that is shown; NaN where there is none."""
    return shown("error", metric, value) if not math.isnan(value) else not_applicable("error", metric, "has none")


def _measure_cold(solver: Solver, scene: Scenario) -> Measurement:
    first_s, second_s = time_first_solves(solver, scene.problem)
    columns = {"first_s": first_s, "second_s": second_s}
    return Measurement("", 0, 0, (), (Series(COLD, columns),))


def _measure_warm(solver: Solver, scene: Scenario, seed: int) -> Measurement:
    spheres = scene.parameters["spheres"]
    assert isinstance(spheres, int)
    return Measurement("", 0, 0, (), (Series(WARM, asdict(measure_warm_start(solver, spheres, seed=seed))),))


def _timing_measurement(timing: Timing, problem: ImpactProblem) -> Measurement:
    """A timing as rows of the store."""
    solution = timing.solution
    repeats = summarize(timing.cpu_s)
    columns = {
        "cpu_s": list(timing.cpu_s), "wall_s": list(timing.wall_s), "solves": timing.solves, "fresh_s": timing.fresh_s,
        "memory_bytes": timing.memory_bytes, "calibration_s": list(timing.calibration_s), "m": problem.m,
        "n": problem.n,
    }  # fmt: skip
    score = shown("time", "median CPU time", repeats.median)
    return Measurement(
        solution.status.label, int(solution.iterations), int(solution.visits), (score,), (Series(TIMES, columns),)
    )


def _count(value: object) -> int:
    """A stored count."""
    assert isinstance(value, int)
    return value
