"""Run a moving scene with one solver: a row a step, frames, checkpoints, the six scores over the run.

    results.sqlite       what was measured: the whole run, and probes of single impacts (see `harness.store`)
    series.csv           one row a step (`COLUMNS`)
    measures.csv         what the scene is judged by, at frames or more often
    trajectory-*.npz     frames (see `harness.trajectory`)
    checkpoint.npz       the whole state, and how many rows and frames go with it

A probe is the impact of one step taken by itself: the solver's answer to it is scored as any impact of the catalog.
A run that is interrupted, or that fails, keeps all steps that it made; the same call goes on, bit for bit.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

import numpy as np
import pandas as pd

from harness import desiderata
from harness.environment import describe_environment
from harness.files import replace_file
from harness.measure import measure_impact
from harness.measurement import (
    InvalidSolution,
    Kind,
    Measurement,
    Outcome,
    Score,
    Task,
    lower_bound,
    not_applicable,
    shown,
    upper_bound,
)
from harness.run import COMPARED
from harness.store import FILE_NAME, Ending, PlannedTask, Store, set_aside
from harness.trajectory import FRAMES, Frame, RowWriter, TrajectoryWriter, read_table
from scenarios.scenario import Invariant, Scenario
from scenarios.world.checkpoint import CheckpointError, checkpoint, resume
from scenarios.world.events import EventWorld
from scenarios.world.impact import Streamed
from scenarios.world.moving_scene import MovingScene, MovingWorld
from scenarios.world.rigid_world import RigidWorld
from scenarios.world.stepping import StepReport
from solvers import ImpactProblem, ProblemError, Solver, UnsupportedProblem
from solvers.solution import Floats

CHECKPOINT = "checkpoint.npz"
STEPS, MEASURES = "series.csv", "measures.csv"
RUN, PROBE = "run", "probe"
"""What the tasks of a simulation are: the parameter "of" of each."""
COLUMNS = (
    "step", "time", "contacts", "status", "iterations", "sweeps", "residual", "overlap", "fastest", "gain",
    "kinetic", "potential", "impact", "friction", "correction", "shaking", "integration", "wall_s",
)  # fmt: skip
"""Columns of the series; all but wall_s come out the same whenever the run is repeated."""
LEDGER = ("impact", "friction", "correction", "shaking", "integration")
"""Those in which a step's change of kinetic and potential energy is booked; their sum is that change."""
TIME_ROUNDING = 1e-12
"""Share by which a time that is a sum of steps may miss the one that is meant."""
# Impacts of a run with a fixed step that are scored by themselves, evenly spread over it.
PROBES = 8
# A probe solves its impact again and again, renumbered and mirrored: above this many contacts that takes minutes.
MOST_PROBED = 2_000


class SimulationError(ValueError):
    """A simulation cannot go on; the text says at which step and why. What it measured is kept."""


@dataclass(frozen=True)
class Schedule:
    """How long a simulation runs, and what it leaves behind when."""

    steps: int
    """Steps of the whole run, those of earlier calls included."""
    frame_every: int
    """Steps between two frames; the last step has one in any case."""
    checkpoint_every: int
    """Steps between two checkpoints."""
    duration: float = math.inf
    """Time of the whole run; it ends before if its steps are made."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value < 1 and name != "duration":
                raise SimulationError(f"{name} must be at least 1, not {value}")
        if not self.duration > 0.0:
            raise SimulationError(f"duration must be above 0, not {self.duration:g}")


@dataclass(frozen=True)
class Simulation:
    """What is run."""

    scene: MovingScene
    specification: str
    """The solver, as results are labeled."""
    solver: Solver | Streamed
    seed: int


@dataclass(frozen=True)
class State:
    """How far a simulation is."""

    report: StepReport
    steps: int
    """Steps of the whole run."""
    measures: Mapping[str, float]
    """What the scene measured last."""
    energy_unit: str = "J"


def simulate(
    simulation: Simulation,
    folder: Path,
    schedule: Schedule,
    *,
    command: str,
    until: Callable[[Mapping[str, float]], bool] = lambda _: False,
    on_step: Callable[[State], None] = lambda _: None,
) -> str:
    """Run a scene, or go on with it.

    Args:
        simulation: scene, solver, seed.
        folder: results folder of this run alone.
        schedule: how long, and what is kept when.
        command: as it was called, for the record.
        until: ends the run where it says so of the scene's measures, when they are taken.
        on_step: called after every step.

    Returns:
        Why the run ended, in words.

    Raises:
        SimulationError: the scene cannot go on: a step too large, a solver that refuses it.
        StoreError: the folder cannot be used, or holds another simulation.
        KeyboardInterrupt: all steps made are kept; the same call goes on.
    """
    environment = describe_environment()
    comparable = {key: environment[key] for key in COMPARED if key != "cpu"}
    identity = {"results of": "simulation", "scene": simulation.scene.label, "solver": simulation.specification}
    with Store.create_or_open(folder, {**comparable, **identity, "seed": simulation.seed}) as store:
        run = store.begin_run(
            version=str(environment["impactbench"]), environment=environment,
            settings={**identity, **asdict(schedule), "seed": simulation.seed}, command=command,
        )  # fmt: skip
        recorder = _Recorder(simulation, folder, schedule)
        try:
            why = _run(recorder, _Probes(simulation, store, run), schedule, until, on_step)
            recorder.frame_at_the_end()
        finally:
            # Also of a run that cannot go on: its last steps tell why.
            recorder.checkpoint()
            _record_run(simulation, folder, store, run, steps=recorder.world.steps)
        store.finish_run(run)
    return why


def set_aside_run(folder: Path) -> Path | None:
    """Move what a run left into the first free earlier-N/ of its folder, for a fresh start that destroys nothing.

    Returns:
        The new folder, or None where there was no run.

    Raises:
        StoreError: a run is writing to it, or it cannot be renamed.
    """
    store = set_aside(folder)
    kept = {path: path.name for path in (folder / CHECKPOINT, folder / STEPS, folder / MEASURES) if path.exists()}
    kept |= {path: path.name for path in folder.glob(FRAMES)}
    if store is not None:
        # With the log of a killed run, without which rows would be missing.
        parts = {store.with_name(store.name + suffix): FILE_NAME + suffix for suffix in ("-wal", "-shm", "")}
        kept |= {path: name for path, name in parts.items() if path.exists()}
    if not kept:
        return None
    number = 1
    while (aside := folder / f"earlier-{number}").exists():
        number += 1
    aside.mkdir()
    for path, name in kept.items():
        path.rename(aside / name)
    return aside


def _run(
    recorder: _Recorder,
    probes: _Probes,
    schedule: Schedule,
    until: Callable[[Mapping[str, float]], bool],
    on_step: Callable[[State], None],
) -> str:
    """Step until the schedule or the scene says that it is enough."""
    world = recorder.world
    while world.steps < schedule.steps:
        ahead = recorder.next_time()
        if ahead > schedule.duration or ahead == math.inf:
            recorder.watch(schedule.duration)
            end = "no further impact will come" if ahead == math.inf else f"the time {schedule.duration:.6g} is reached"
            return f"{end} after step {world.steps}"
        try:
            if _is_probed(world, schedule):
                probes.take(world)
            with _uninterrupted():
                report = recorder.step(ahead)
        except (ProblemError, UnsupportedProblem, InvalidSolution) as error:
            raise SimulationError(f"step {world.steps + 1}: {error}") from error
        on_step(State(report, schedule.steps, recorder.measures, recorder.energy_unit))
        if recorder.measured_now and until(recorder.measures):
            return f"what was waited for holds at step {world.steps}"
    return f"all {schedule.steps} steps are made"


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold an interruption back to the end: a world halfway through a step must not become a checkpoint.

    A second interruption is not held back.
    """
    asked = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            signal.default_int_handler(number, frame)
        asked = True

    # Only the main thread has signals, and only those that would interrupt are held.
    main = threading.current_thread() is threading.main_thread()
    held = [s for s in (signal.SIGINT, signal.SIGTERM) if main and signal.getsignal(s) is signal.default_int_handler]
    for number in held:
        signal.signal(number, hold)
    try:
        yield
    finally:
        for number in held:
            signal.signal(number, signal.default_int_handler)
    if asked:
        raise KeyboardInterrupt


def _is_probed(world: MovingWorld, schedule: Schedule) -> bool:
    """Whether the next impact is scored by itself."""
    if isinstance(world, EventWorld):
        # Nobody knows how many impacts will come: the first, second, fourth, eighth, …
        return (world.steps + 1).bit_count() == 1
    every = max(schedule.steps // PROBES, 1)
    return world.steps % every == every // 2


class _Recorder:
    """A world whose every step is written down."""

    def __init__(self, simulation: Simulation, folder: Path, schedule: Schedule) -> None:
        self._folder, self._schedule, self._scene = folder, schedule, simulation.scene
        self.energy_unit = simulation.scene.units.energy
        try:
            self.world = simulation.scene.world(solver=simulation.solver, seed=simulation.seed)
            kept = folder / CHECKPOINT
            resumed = kept.exists()
            if resumed:
                resume(self.world, kept.read_bytes())
        except CheckpointError as error:
            raise SimulationError(f"{folder / CHECKPOINT}: {error}") from error
        except ProblemError as error:
            raise SimulationError(str(error)) from error
        made = self.world.steps
        self._timed = isinstance(self.world, EventWorld)
        self._measure_every = schedule.frame_every if self._timed else self._scene.measure_every or schedule.frame_every
        # Frames of a scene from impact to impact are those before its last impact, and one at the start.
        frames = self._due(self.world.time) if self._timed else made // schedule.frame_every + 1
        measured = frames if self._timed else made // self._measure_every + 1
        self.measures = dict(self._scene.measure(self.world))
        self.measured_now = False
        """Whether they were taken in the last step, or in the flight before it."""
        self._rows = RowWriter(folder / STEPS, COLUMNS, rows=made)
        columns = ("step", "time", *self.measures)
        self._measured = RowWriter(folder / MEASURES, columns, rows=measured if resumed else 0)
        self._trajectory = TrajectoryWriter(folder, frames=frames if resumed else 0)
        if not resumed:
            self._frame()
            self._measure()

    def step(self, ahead: float) -> StepReport:
        """Go on by one step, which is known to end at a time where the scene goes from impact to impact."""
        self.measured_now = False
        if self._timed:
            self._watch_until(self._due(ahead))
        begin = time.perf_counter()
        report = self.world.step()
        wall_s = time.perf_counter() - begin
        known = asdict(report) | asdict(report.energy) | {"status": report.status.label, "wall_s": wall_s}
        self._rows.append([known[column] for column in COLUMNS])
        if not self._timed and self.world.steps % self._measure_every == 0:
            self._measure()
        if not self._timed and self.world.steps % self._schedule.frame_every == 0:
            self._frame()
        if self.world.steps % self._schedule.checkpoint_every == 0:
            self.checkpoint()
        return report

    def next_time(self) -> float:
        """Time of the next impact where the scene goes from impact to impact, else a time after now; inf at the end."""
        world = self.world
        if isinstance(world, EventWorld):
            return world.time + world.flight.time_to_impact()
        # Times are sums of steps: rounding must not add one.
        return math.inf if world.over else world.time * (1.0 + TIME_ROUNDING) + math.ulp(0.0)

    def watch(self, until: float) -> None:
        """Take the frames of a free flight up to a time, that one included."""
        if self._timed and math.isfinite(until):
            # A time that is a whole number of frames may miss the last one by rounding.
            self._watch_until(math.floor(until / self._scene.frame_time * (1.0 + TIME_ROUNDING)) + 1)

    def frame_at_the_end(self) -> None:
        """Take a frame of the last step, where none is due; a run that is given more steps drops it."""
        if not self._timed and self.world.steps % self._schedule.frame_every != 0:
            self._frame()

    def checkpoint(self) -> None:
        """Keep the state. Rows and frames first: a checkpoint never says more than there is."""
        self._rows.flush()
        self._measured.flush()
        self._trajectory.flush()
        replace_file(self._folder / CHECKPOINT, checkpoint(self.world))

    def _due(self, now: float) -> int:
        """Frames before a time, where they are at equal times; the first one is of the start, impact or not."""
        return max(math.ceil(now / self._scene.frame_time), 1)

    def _watch_until(self, frames: int) -> None:
        """Take the frames that are missing of so many, in the flight to the next impact; the world stays as it is."""
        world = self.world
        assert isinstance(world, EventWorld)
        if frames <= self._trajectory.frames:
            return
        here = {name: array.copy() for name, array in world.state().items()}
        for k in range(self._trajectory.frames, frames):
            moment = k * self._scene.frame_time
            try:
                world.flight.advance(moment - world.time)
                world.time = moment
                self._frame()
                self._measure()
            finally:
                # Also where it is interrupted: the checkpoint is of the last impact.
                world.restore(here)

    def _measure(self) -> None:
        self.measured_now = True
        self.measures = dict(self._scene.measure(self.world))
        self._measured.append([self.world.steps, self.world.time, *self.measures.values()])

    def _frame(self) -> None:
        world = self.world
        height = world.container.motion.height(world.time)
        self._trajectory.append(
            Frame(
                world.steps, world.time, height,
                world.spheres.by_label(world.spheres.place), world.spheres.by_label(world.spheres.velocity),
                world.orientation.copy() if isinstance(world, RigidWorld) else np.zeros((0, 4)),
            )
        )  # fmt: skip


class _Probes:
    """Impacts of single steps, scored as any impact; those that are stored already are not taken again."""

    def __init__(self, simulation: Simulation, store: Store, run: int) -> None:
        self._simulation, self._store, self._run = simulation, store, run

    def take(self, world: MovingWorld) -> None:
        """Score the impact that the next step will solve, if it has contacts and is not too large."""
        solver = self._simulation.solver
        if isinstance(solver, Streamed):
            return
        problem = world.problem()
        if not 0 < problem.m <= MOST_PROBED:
            return
        (number,) = self._store.plan([_task(self._simulation, PROBE, step=world.steps)], run=self._run)
        if number not in {planned.number for planned in self._store.pending()}:
            return
        scenario = _scenario(self._simulation.scene, problem, world.spheres.count, world.steps)
        begin = time.perf_counter()
        try:
            measured = measure_impact(solver, scenario, seed=self._simulation.seed)
        except UnsupportedProblem as refusal:
            # The step itself will be refused as well, and end the run; the row says why.
            self._store.record(number, Ending(Outcome.REFUSED, str(refusal)), run=self._run)
            return
        ending = Ending(Outcome.MEASURED, wall_s=time.perf_counter() - begin, measurement=measured)
        self._store.record(number, ending, run=self._run)


def _record_run(simulation: Simulation, folder: Path, store: Store, run: int, *, steps: int) -> None:
    """Store what holds of all steps together."""
    if steps == 0:
        return
    (number,) = store.plan([_task(simulation, RUN, steps=steps)], run=run)
    if number in {planned.number for planned in store.pending()}:
        store.record(number, _whole_run(folder, simulation), run=run)


def _task(simulation: Simulation, what: str, **more: object) -> PlannedTask:
    """The whole run, or one probe of it."""
    scene = simulation.scene
    parameters = {"of": what, "scene": dict(scene.parameters), **more}
    task = Task(Kind.SIMULATION, simulation.specification, scene.name, parameters, simulation.seed)
    label = scene.label + "".join(f", {key} {value}" for key, value in more.items())
    return PlannedTask(task, {}, label, frozenset({"moving"}))


def _scenario(scene: MovingScene, problem: ImpactProblem, bodies: int, step: int) -> Scenario:
    """The impact of one step as a scenario: what it conserves is read off its contacts."""
    # Velocity alone, or velocity and spin: vectors in space. Anything else (pendulums) is a coordinate of its own kind.
    in_space = problem.n in (3 * bodies, 6 * bodies)
    return Scenario(
        scene.name, {**scene.parameters, "step": step}, problem, scene.source,
        invariants=tuple(_momenta(problem, problem.n // bodies)) if in_space else (),
        tags=frozenset({"moving", "friction"} if problem.has_friction else {"moving"}),
        dofs_per_body=3 if in_space else 1,
    )  # fmt: skip


def _momenta(problem: ImpactProblem, block: int) -> Iterator[Invariant]:
    """Linear momenta along the axes that no contact with an immovable body takes away."""
    for axis, name in enumerate("xyz"):
        direction = np.zeros(problem.n)
        direction[axis::block] = 1.0
        rows = [problem.J] if problem.D is None else [problem.J, problem.D]
        # A difference of two equal numbers: exactly zero, or a wall.
        if all(not (matrix @ direction).any() for matrix in rows):
            yield Invariant(f"momentum {name}", direction)


def _whole_run(folder: Path, simulation: Simulation) -> Ending:
    """What holds of all steps together, from the series."""
    series = read_table(folder / STEPS)
    column = {name: series[name].to_numpy() for name in COLUMNS if name != "status"}
    measures = read_table(folder / MEASURES)
    scores = [*_energy_scores(column), *_statistics(column), *_last_measures(measures)]
    scores += [*_judged_scores(measures, simulation.scene.judged), *_unjudged(simulation)]
    unfinished = float((series["status"] != "converged").mean())
    scores.append(shown("run", "steps whose impact did not converge", unfinished))
    last = str(series["status"].iloc[-1])
    return Ending(
        Outcome.MEASURED, wall_s=float(column["wall_s"].sum()),
        measurement=Measurement(last, int(column["iterations"].sum()), int(column["contacts"].sum()), tuple(scores)),
    )  # fmt: skip


def _energy_scores(column: Mapping[str, Floats]) -> Iterator[Score]:
    """KIN over all steps: kinetic energy that the impulses of an impact gained, over that before them."""
    change = column["gain"]
    worst = int(change.argmax())
    yield upper_bound(
        "KIN", "energy gained in an impact", float(max(change[worst], 0.0)), desiderata.ENERGY_TOLERANCE,
        detail={"step": int(column["step"][worst])},
    )  # fmt: skip
    yield shown("KIN", "energy error e, mean over the steps", float(np.abs(change).mean()))
    total = {name: float(column[name].sum()) for name in LEDGER}
    scale = float(np.abs(column["kinetic"]).max()) or 1.0
    for name, joule in total.items():
        yield shown("energy", f"{name}, over the largest kinetic energy", joule / scale)


def _statistics(column: Mapping[str, Floats]) -> Iterator[Score]:
    """Counts and times, as Table 2 of Zhang 2015 gives them."""
    for name in ("contacts", "iterations", "sweeps", "residual", "overlap", "wall_s"):
        values = column[name][np.isfinite(column[name])]
        if values.size == 0:
            yield not_applicable("run", f"{name}, mean", "the solver does not tell")
            continue
        for word, value in (("mean", values.mean()), ("largest", values.max()), ("smallest", values.min())):
            yield shown("run", f"{name}, {word}", float(value))


def _last_measures(measures: pd.DataFrame) -> Iterator[Score]:
    """The scene's own measures at the last frame."""
    for name in measures.columns:
        if name not in ("step", "time"):
            yield shown("scene", f"{name}, at the end", float(measures[name].iloc[-1]))


def _judged_scores(measures: pd.DataFrame, judged: Mapping[str, str]) -> Iterator[Score]:
    """SYM and BRK over the run, where the scene has a measure for them; the bounds are those of a single impact."""
    for name, measure in judged.items():
        values = measures[measure].dropna()
        if values.empty:
            yield not_applicable(name, measure, "the run is too short for it")
        elif name == "SYM":
            wrong = values > desiderata.SYMMETRY_TOLERANCE
            # Billiards multiply any difference at every impact: when it began to grow says more than how far it got.
            since = {"passes until step": int(measures["step"][wrong.idxmax()])} if wrong.any() else {}
            yield upper_bound(
                name, f"{measure}, largest over the run", float(values.max()), desiderata.SYMMETRY_TOLERANCE,
                detail=since,
            )  # fmt: skip
        else:
            yield lower_bound(
                name, f"{measure}, smallest over the run", float(values.min()), desiderata.BREAK_TOLERANCE,
                detail={"step": int(measures["step"][values.idxmin()])},
            )  # fmt: skip


def _unjudged(simulation: Simulation) -> Iterator[Score]:
    """Why a run has no number for some of the six."""
    yield not_applicable("WAV", "wave effect", "a run takes one course, and WAV compares neighboring ones: scorecard")
    judged = simulation.scene.judged
    if "BRK" not in judged:
        yield not_applicable("BRK", "break-away", "nothing says what should part in this scene")
    if isinstance(simulation.solver, Streamed):
        for name in ("SYM", "MOM", "ONE"):
            yield not_applicable(name, "single impacts", "the packed solver keeps no impulses to judge; qce-lcp does")
