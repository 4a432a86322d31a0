"""impactbench: measure laws of multi-impact against what an impact must do. The command line, and the names to import.

    impactbench scorecard                      measure, and read the card
    from impactbench import SOLVERS, ImpactProblem, CATALOG

Everything below is imported when it is used, so that `--help` answers at once.
"""

from __future__ import annotations

import importlib
import math
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from rich.console import Console

    from harness.measure import measure_impact, measure_sweep
    from harness.measurement import Measurement, Score, Verdict
    from harness.revision import TimeComparison
    from harness.run import Summary
    from harness.simulation import Schedule, Simulation
    from harness.store import PlannedTask, Store
    from scenarios import CATALOG
    from scenarios.scenario import Reference, Scenario
    from scenarios.world.moving_scene import MovingScene
    from solvers import SOLVERS, ImpactProblem, ImpactSolution, ProblemError, Solver, Status, UnsupportedProblem

_HOMES = {
    "CATALOG": "scenarios",
    "ImpactProblem": "solvers",
    "ImpactSolution": "solvers",
    "Measurement": "harness.measurement",
    "ProblemError": "solvers",
    "Reference": "scenarios.scenario",
    "SOLVERS": "solvers",
    "Scenario": "scenarios.scenario",
    "Score": "harness.measurement",
    "Solver": "solvers",
    "Status": "solvers",
    "Store": "harness.store",
    "UnsupportedProblem": "solvers",
    "Verdict": "harness.measurement",
    "measure_impact": "harness.measure",
    "measure_sweep": "harness.measure",
}
"""Facade name → module that has it."""

__all__ = [
    "CATALOG", "ImpactProblem", "ImpactSolution", "Measurement", "ProblemError", "Reference", "SOLVERS", "Scenario",
    "Score", "Solver", "Status", "Store", "UnsupportedProblem", "Verdict", "main", "measure_impact", "measure_sweep",
]  # fmt: skip

EXIT_FAILED_TASKS = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
# Columns of a table that goes to a file or a pipe.
PLAIN_WIDTH = 120
# Failures shown one by one at the end; the others are in the report.
SHOWN_FAILURES = 10
# Options of a first call: what it began goes on without them.
ONCE = ("--fresh", "--retry")
# Rows that stand behind a claim, as far as they are named.
SHOWN_ROWS = 4

EXIT_CODES = """
\b
Exit codes:
  0    every task was measured or refused by its solver (verdicts do not change the exit code)
  1    a task crashed, timed out, ran out of memory, raised, or gave an invalid answer
  2    bad usage or input: unknown names, an unusable results folder
  130  interrupted; the same command goes on where it stopped
"""

# "\b" in a docstring keeps click from filling the paragraph below it (hence D301 is off there).
Command = TypeVar("Command", bound=Callable[..., Any])


def __getattr__(name: str) -> object:
    """Import a facade name when it is first used."""
    if name in _HOMES:
        _prepare()
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class BadInput(click.ClickException):
    """What the user asked for cannot be done; the text says why and what to do."""

    exit_code = EXIT_BAD_INPUT


class _Version:
    """Looks the version up only when it is asked for."""

    def __call__(self, context: click.Context, _parameter: click.Parameter, asked: bool) -> None:
        if asked and not context.resilient_parsing:
            from harness.environment import package_version

            click.echo(f"impactbench {package_version()}")
            context.exit()


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog=EXIT_CODES,
)
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_Version(), help="Show the version and exit."
)
def main() -> None:
    """Measure laws of multi-impact: what happens when many touching bodies are struck at once.

    Every law (solver) meets every scene; each answer is scored on six desiderata (WAV, BRK, SYM, KIN, MOM, ONE), on
    robustness, invariance and termination, and against references. All numbers are kept in one results folder.

    \b
    Start here:
      impactbench scorecard                      measure the default tier, print the card, draw the figures
      impactbench scorecard --tier smoke         the same in seconds, on a few scenes
      impactbench list                           what there is to measure
      impactbench replay qce three-ball-chain:va=0.5
                                                 one solver on one scene, with all its numbers
    """  # noqa: D301


def _selection_options(command: Command) -> Command:
    """Options that say what is measured."""
    for option in (
        click.option("--tier", default="default", show_default=True, help="Scenes: smoke, default, full or hard."),
        click.option(
            "--scenario", "scenarios", multiple=True, metavar="NAME[:KEY=VALUE,…]",
            help="Only this family, member or sweep; patterns as 'pool-*' too. Repeatable.",
        ),
        click.option(
            "--solver", "solvers", multiple=True, metavar="NAME[:KEY=VALUE,…]",
            help="Only this solver: a name, or path.py:Class for yours. Repeatable. Default: every law, by one method.",
        ),
    ):  # fmt: skip
        command = option(command)
    return command


def _limit_options(command: Command) -> Command:
    """Options that bound a task, and start a run anew."""
    for option in (
        click.option("--fresh", is_flag=True, help="Set earlier results aside (renamed, not deleted) and start anew."),
        click.option("--retry", is_flag=True, help="Measure again what crashed, failed or went over its limits."),
        click.option(
            "--memory", "memory_mb", type=click.FloatRange(min=1), default=4096, show_default=True, metavar="MIB",
            help="Memory that one task may allocate.",
        ),
        click.option(
            "--timeout", "timeout_s", type=click.FloatRange(min=0, min_open=True), default=120, show_default=True,
            metavar="SECONDS", help="Time that one task may take; then its process is killed.",
        ),
    ):  # fmt: skip
        command = option(command)
    return command


def _jobs_option(command: Command) -> Command:
    """Tasks at a time."""
    return click.option(
        "--jobs", type=click.IntRange(min=1), default=None, metavar="N",
        help="Tasks at a time. Default: the number of cores.",
    )(command)  # fmt: skip


def _seed_option(command: Command) -> Command:
    """The seed of a run."""
    return click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Base of all seeds.")(
        command
    )


def _run_options(command: Command) -> Command:
    """Options that say how it is measured, and where results go."""
    return _limit_options(_seed_option(_jobs_option(_out_option(command))))


def _out_option(command: Command) -> Command:
    """The results folder."""
    return click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("results"), show_default=True,
        help="Results folder.",
    )(command)  # fmt: skip


@main.command(epilog=EXIT_CODES)
@_selection_options
@_run_options
@click.option("--no-figures", is_flag=True, help="Write the tables only.")
def scorecard(out: Path, no_figures: bool, **options: Any) -> None:
    """Measure a tier and print the scorecard.

    Measured rows are kept in OUT/results.sqlite as they come: an interrupted run goes on where it stopped when the
    same command is given again. Then tables (Markdown, LaTeX, CSV) and figures (PDF, SVG, PNG) are written into OUT.

    \b
    Examples:
      impactbench scorecard
      impactbench scorecard --tier smoke --out /tmp/smoke
      impactbench scorecard --solver qce --solver my_law.py:MyLaw --scenario 'pool-*'
      impactbench scorecard --solver qce:tolerance=1e-8 --scenario three-ball-chain:va=0.25
    """  # noqa: D301
    with _explained_errors():
        failures = _measure(out, **options)
        _write_reports(out, _tables_only if no_figures else _tables_and_what_can_be_drawn)
    sys.exit(EXIT_FAILED_TASKS if failures else 0)


@main.command(epilog=EXIT_CODES)
@_selection_options
@_run_options
def run(out: Path, **options: Any) -> None:
    """Measure and store, without a report.

    \b
    Examples:
      impactbench run --tier full --jobs 8 --out full
      impactbench run --solver my_law.py:MyLaw      add a solver to the results in ./results
    """  # noqa: D301
    with _explained_errors():
        failures = _measure(out, **options)
    sys.exit(EXIT_FAILED_TASKS if failures else 0)


@main.command(epilog=EXIT_CODES)
@click.option("--tier", default="default", show_default=True, help="How much is measured: smoke, default or full.")
@click.option(
    "--scenario",
    "scenarios",
    multiple=True,
    metavar="NAME[:KEY=VALUE,…]",
    help="Only this family or member. Repeatable.",
)
@click.option(
    "--solver",
    "solvers",
    multiple=True,
    metavar="NAME[:KEY=VALUE,…]",
    help="Only this solver; one named with its accuracy setting is not swept. Repeatable. Default: all.",
)
@click.option("--sizes", default="", metavar="N,N,…", help="Spheres of the scaling packs. Default: those of the tier.")
@click.option("--repeats", type=int, default=None, metavar="N", help="Rounds of timing. Default: those of the tier.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="N",
    help="Error runs at a time; times are always taken one at a time.",
)
@_seed_option
@_limit_options
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("bench"),
    show_default=True,
    help="Results folder of its own: a scorecard's is refused.",
)
def bench(
    out: Path, tier: str, scenarios: tuple[str, ...], solvers: tuple[str, ...], sizes: str, repeats: int | None,
    jobs: int, seed: int, timeout_s: float, memory_mb: float, fresh: bool, retry: bool,
) -> None:  # fmt: skip
    """Measure speed against error, growth with size, and first solves; then write bench.md, CSV and figures.

    An interrupted bench goes on where it stopped when the same command is given again.

    \b
    Examples:
      impactbench bench --tier smoke
      impactbench bench --solver qce --solver gr --scenario sphere-pack --sizes 300,1000,4000
      impactbench bench --solver my_law.py:MyLaw --scenario three-ball-chain:va=0.5
    """  # noqa: D301
    with _explained_errors():
        from harness.isolation import Limits
        from harness.work_precision import choose_bench, plan_bench, run_bench
        from reports.bench import write_bench
        from reports.progress import progress_display

        try:
            wanted = [int(size) for size in sizes.split(",") if size.strip()]
        except ValueError:
            raise BadInput(f"--sizes must be whole numbers with commas between, not {sizes!r}") from None
        chosen, families = choose_bench(solvers, scenarios)
        plan = plan_bench(chosen, tier=tier, scenarios=families, sizes=wanted, repeats=repeats, seed=seed)
        if fresh:
            _set_aside(out)
        click.echo(f"{len(plan)} tasks; results go to {out / 'results.sqlite'}", err=True)
        try:
            with _terminated_as_interrupted(), progress_display() as display:
                summary = run_bench(
                    out, plan, seed=seed, jobs=jobs, limits=Limits(timeout_s, memory_mb), command=_command_line(),
                    on_progress=display, retry=retry,
                )  # fmt: skip
        except KeyboardInterrupt:
            click.echo(f"\ninterrupted; the same command goes on:\n  {_command_line(without=ONCE)}", err=True)
            sys.exit(EXIT_INTERRUPTED)
        _print_summary(out, summary)
        with _open(out) as store:
            _name_bench_files(out, write_bench(store, out))
    sys.exit(EXIT_FAILED_TASKS if summary.lost else 0)


@main.command(epilog=EXIT_CODES)
@click.argument("scenes", metavar="SCENE[:KEY=VALUE,…]…", nargs=-1, required=True)
@click.option(
    "--solver", "solvers", multiple=True, metavar="NAME[:KEY=VALUE,…]",
    help="Who solves the impacts: any solver, or qce-lcp-fast and qce-lcp-accurate, which are made for many spheres. "
    "Repeatable. Default: the scene's own.",
)  # fmt: skip
@click.option("--steps", type=click.IntRange(min=1), default=None, metavar="N", help="Steps of the whole run.")
@click.option(
    "--cycles", type=click.IntRange(min=1), default=None, metavar="N",
    help="Periods of what drives the scene, instead of --steps.",
)  # fmt: skip
@click.option("--until-pattern", is_flag=True, help="Stop when the scene's measures show what it is for.")
@click.option(
    "--frames", "frame_every", type=click.IntRange(min=1), default=None, metavar="N",
    help="Steps between two frames; the last step has one, too.",
)  # fmt: skip
@click.option(
    "--checkpoint", "checkpoint_every", type=click.IntRange(min=1), default=1000, show_default=True, metavar="N",
    help="Steps between two checkpoints; an interruption leaves one too.",
)  # fmt: skip
@click.option("--pictures/--no-pictures", default=True, show_default=True, help="Draw stills of the run.")
@click.option("--video", is_flag=True, help="Draw a video too; needs the extra: pip install 'impactbench[render]'.")
@_seed_option
@click.option("--fresh", is_flag=True, help="Set earlier results aside (renamed, not deleted) and start anew.")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("simulation"), show_default=True,
    help="Results folder of this run alone.",
)  # fmt: skip
def simulate(
    scenes: tuple[str, ...], solvers: tuple[str, ...], steps: int | None, cycles: int | None, until_pattern: bool,
    frame_every: int | None, checkpoint_every: int, pictures: bool, video: bool, seed: int, fresh: bool, out: Path,
) -> None:  # fmt: skip
    """Run a moving scene; then write its page, figures and pictures.

    Every step is a row of OUT/series.csv; frames, what the scene is judged by, and a checkpoint are kept beside it. An
    interrupted run goes on, bit for bit, when the same command is given again, and so does one that is given more
    steps. `impactbench list moving` names the scenes and their parameters. Several solvers, or several members of one
    family of scenes, run one after the other in folders of their own in OUT, and a page compares them.

    \b
    Examples:
      impactbench simulate cradle-3d --solver qce --out cradle
      impactbench simulate cradle-3d:raised=1 cradle-3d:raised=2 cradle-3d:raised=3 --out cradles
      impactbench simulate pool-break --solver qce --solver gr --solver lcp-pgs --out break
      impactbench simulate granular-shake --video --out shake
      impactbench simulate extended-pattern:pattern=hexagons --cycles 300 --until-pattern --out hexagons
    """  # noqa: D301
    with _explained_errors():
        from harness.selection import choose_moving, choose_resolver
        from harness.simulation import Simulation

        # What is named twice runs once.
        chosen = {choice.label: choice for choice in map(choose_moving, scenes)}
        if len({choice.name for choice in chosen.values()}) > 1:
            raise BadInput("several scenes must be members of one family: they are compared")
        runs = {
            _run_name(choice, specification, chosen.values(), solvers): (choice, specification, law)
            for choice in chosen.values()
            for specification, law in map(choose_resolver, solvers or (choice.default_solver,))
        }
        folders = {name: out / _folder_name(name) if len(runs) > 1 else out for name in runs}
        for folder in folders.values() if fresh else ():
            _set_aside_run(folder)
        for name, (choice, specification, law) in runs.items():
            schedule = _schedule(choice, steps, cycles, frame_every, checkpoint_every)
            _say(f"{choice.label} by {specification}: {_extent(choice, schedule)}; results go to {folders[name]}")
            _run_simulation(Simulation(choice, specification, law, seed), folders[name], schedule, until_pattern)
            _write_simulation(folders[name], choice, pictures=pictures, video=video)
        if len(runs) > 1:
            _write_comparison(folders, out, choice)


def _run_name(scene: MovingScene, solver: str, scenes: Collection[MovingScene], solvers: Collection[str]) -> str:
    """What tells a run from the others: its scene's parameters that differ, its solver, or both."""
    own = [
        f"{name}={value}" for name, value in scene.parameters.items()
        if any(other.parameters.get(name) != value for other in scenes)
    ]  # fmt: skip
    return ", ".join([*own, solver] if len(solvers) > 1 or not own else own)


def _run_simulation(simulation: Simulation, out: Path, schedule: Schedule, until_pattern: bool) -> None:
    """Run one scene by one solver, or say how an interrupted run goes on."""
    from harness.simulation import simulate as run_simulation
    from reports.progress import step_display

    try:
        with _terminated_as_interrupted(), step_display() as display:
            why = run_simulation(
                simulation, out, schedule, command=_command_line(),
                until=simulation.scene.reached if until_pattern else lambda _: False, on_step=display,
            )  # fmt: skip
    except KeyboardInterrupt:
        _say(f"\ninterrupted; the same command goes on:\n  {_command_line(without=ONCE)}")
        sys.exit(EXIT_INTERRUPTED)
    _say(why)


def _folder_name(run: str) -> str:
    """A run's folder: its name without what a path may not hold."""
    return re.sub(r"[^\w.=,-]+", "_", run)


def _schedule(
    scene: MovingScene, steps: int | None, cycles: int | None, frame_every: int | None, checkpoint_every: int
) -> Schedule:  # fmt: skip
    """How long a scene runs: as it says itself, or as it is told in steps or cycles."""
    from harness.simulation import Schedule

    if steps is not None and cycles is not None:
        raise BadInput("--steps and --cycles say the same thing; give one")
    duration = scene.duration if steps is None else math.inf
    if cycles is not None:
        if scene.steps_per_cycle == 0 and math.isinf(scene.period):
            raise BadInput(f"{scene.name} has no cycles: nothing in it repeats; give --steps")
        steps, duration = cycles * scene.steps_per_cycle or None, cycles * scene.period
    return Schedule(steps or scene.default_steps, frame_every or scene.frame_every, checkpoint_every, duration)


def _extent(scene: MovingScene, schedule: Schedule) -> str:
    """How long a run is, in words."""
    if math.isinf(schedule.duration):
        return f"{schedule.steps} steps"
    return f"{schedule.duration:.6g} {scene.units.time}, {schedule.steps} steps at most"


def _write_simulation(out: Path, scene: MovingScene, *, pictures: bool, video: bool) -> None:
    from reports.simulation import write_pictures, write_simulation

    with _open(out) as store:
        written = write_simulation(store, out, scene)
    if pictures or video:
        written += write_pictures(out, scene, video=video, progress=_say)
    click.echo((out / "simulation.md").read_text(encoding="utf-8"))
    click.echo("written: " + ", ".join(str(path) for path in written if path.suffix in (".md", ".png", ".mp4")))


def _write_comparison(runs: dict[str, Path], out: Path, scene: MovingScene) -> None:
    from reports.comparison import write_comparison

    written = write_comparison(runs, out, scene)
    click.echo((out / "comparison.md").read_text(encoding="utf-8"))
    click.echo("written: " + ", ".join(str(path) for path in written if path.suffix in (".md", ".png")))


@main.command()
@click.argument("runs", nargs=-1, metavar="[RUN]…", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("patterns"), show_default=True,
    help="Folder of the records.",
)  # fmt: skip
@click.option(
    "--beside", type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of records with other settings, whose last maps a table sets beside these.",
)  # fmt: skip
def patterns(runs: tuple[Path, ...], out: Path, beside: Path | None) -> None:
    """Keep the height maps of extended-pattern runs; then write table and figures of all that are kept.

    Each RUN is a results folder of `simulate`; what it has to show goes into one small file in OUT, in place of an
    earlier one of the same pattern. Without RUN the table and the figures are made again from these files alone.

    \b
    Examples:
      impactbench patterns hexagons squares
      impactbench patterns
      impactbench patterns --beside patterns/no-tangential-restitution
    """  # noqa: D301
    with _explained_errors():
        from harness.patterns import read_record, record_of_run, write_record
        from reports.files import prepare
        from reports.patterns import write_patterns

        prepare(out)
        for run in runs:
            record = record_of_run(run)
            _say(f"written: {write_record(out / f'{record.pattern}.npz', record)}")
        others = [] if beside is None else [read_record(path) for path in sorted(beside.glob("*.npz"))]
        if beside is not None and not others:
            raise click.UsageError(f"--beside: {beside} holds no records of patterns")
        written = write_patterns([read_record(path) for path in sorted(out.glob("*.npz"))], out, others)
        click.echo((out / "patterns.md").read_text(encoding="utf-8"))
        click.echo("written: " + ", ".join(str(path) for path in written))


@main.command()
@_out_option
def figures(out: Path) -> None:
    """Write tables and figures again from the results in OUT, a scorecard's or a bench's; nothing is measured.

    \b
    Examples:
      impactbench figures --out results
      impactbench figures --out bench
    """  # noqa: D301
    with _explained_errors():
        from reports.bench import write_bench
        from reports.bench_rows import holds_bench

        with _open(out) as store:
            if holds_bench(store):
                _name_bench_files(out, write_bench(store, out))
                return
        _write_reports(out, _tables_and_figures)


@main.command()
@_out_option
def claims(out: Path) -> None:
    """Print the paper's claims beside what was measured in OUT.

    Zhang et al. 2015 is the paper. A verdict is derived from the stored rows that stand beside it, never written here.

    \b
    Example:
      impactbench claims --out results
    """  # noqa: D301
    with _explained_errors():
        from rich.table import Table

        from harness.claims import check_claims
        from harness.results import Results

        with _open(out) as store:
            findings = check_claims(Results(store))
        table = Table(title="Claims", show_lines=True)
        for heading in ("claim", "where", "measured", "finding"):
            table.add_column(heading, overflow="fold")
        for finding in findings:
            claim, evidence = finding.claim, finding.evidence
            shown = evidence.rows[:SHOWN_ROWS]
            more = ", …" if len(evidence.rows) > len(shown) else ""
            rows = f"\n({', '.join(shown)}{more})" if shown else ""
            table.add_row(
                claim.statement, f"{claim.source}, {claim.where}", evidence.verdict.value, evidence.summary + rows
            )
        _console().print(table)


@main.command(name="list")
@click.argument("what", type=click.Choice(["solvers", "scenarios", "moving", "sweeps", "tiers"]), required=False)
def list_names(what: str | None) -> None:
    """List solvers with their settings, scenarios and moving scenes with their parameters, sweeps, tiers.

    \b
    Examples:
      impactbench list
      impactbench list scenarios
    """  # noqa: D301
    with _explained_errors():
        sections: dict[str, Callable[[], None]] = {
            "solvers": _list_solvers, "scenarios": _list_scenarios, "moving": _list_moving, "sweeps": _list_sweeps,
            "tiers": _list_tiers,
        }  # fmt: skip
        for name in [what] if what else sections:
            click.secho(name.upper(), bold=True)
            sections[name]()
            click.echo()


@main.command()
@_out_option
@click.option(
    "--table", type=click.Choice(["results", "tasks", "scores", "series", "runs"]), default="results",
    show_default=True, help="'results' is every score beside its task.",
)  # fmt: skip
@click.option("--format", "form", type=click.Choice(["csv", "json", "parquet"]), default="csv", show_default=True)
@click.option("--to", type=click.Path(dir_okay=False, path_type=Path), help="File to write. Default: standard output.")
def export(out: Path, table: Any, form: str, to: Path | None) -> None:
    """Write one table of the results in OUT for use elsewhere.

    In CSV, structured columns are JSON text. In JSON, missing numbers are null and infinite ones "inf" or "-inf".
    Parquet needs pyarrow: pip install 'impactbench[export]'.

    \b
    Examples:
      impactbench export > results.csv
      impactbench export --table tasks --format json --to tasks.json
    """  # noqa: D301
    with _explained_errors():
        from reports.export import as_csv, as_json, write_parquet

        with _open(out) as store:
            frame = store.frame(table)
        if form == "parquet":
            if to is None:
                raise BadInput("Parquet is no text: name a file with --to")
            write_parquet(frame, to)
            _say(f"written: {to}")
            return
        text = as_csv(frame) if form == "csv" else as_json(frame)
        if to is None:
            click.echo(text, nl=False)
        else:
            _write_text(to, text)


@main.command()
@click.argument("solver")
@click.argument("scenario")
@_seed_option
def replay(solver: str, scenario: str, seed: int) -> None:
    """Run SOLVER on SCENARIO here, in this process, and print velocities and all scores.

    What the solver prints is seen, and a debugger can stop in it. Nothing is stored. The seed is the one that a run
    with the same --seed uses, so the numbers are the stored ones.

    \b
    Examples:
      impactbench replay qce three-ball-chain:va=0.5
      impactbench replay my_law.py:MyLaw newtons-cradle:balls=5
    """  # noqa: D301
    with _explained_errors():
        from harness.selection import build_scenario, choose_scenarios, choose_solver
        from reports.replay import print_replay
        from solvers import UnsupportedProblem

        choice = choose_solver(solver)
        families = choose_scenarios(scenario)
        if len(families) != 1:
            raise BadInput(f"{scenario} names {len(families)} families; name one")
        scene = build_scenario(families[0].name, families[0].parameters)
        try:
            print_replay(choice, scene, seed, _console())
        except UnsupportedProblem as error:
            raise click.ClickException(f"{solver} refuses {scene.label}: {error}") from error


GATE_EXIT_CODES = """
\b
Exit codes:
  0    nothing got worse
  1    a number got worse by more than its allowance, or a solver × scene of the baseline has no answer any more
  2    bad usage or input: no such file, another version, machine, tier or seed, an unknown metric, unusable results
  130  interrupted; the same command goes on where it stopped
"""


def _gate_options(command: Command) -> Command:
    """Options of the gate: with what is compared, and how it is measured."""
    for option in (
        click.option("--no-measure", is_flag=True, help="Take OUT as it is; nothing is measured."),
        click.option(
            "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("results/check"),
            show_default=True, help="Results folder; what it lacks is measured into it.",
        ),
        click.option(
            "--solver", "solvers", multiple=True, metavar="NAME[:KEY=VALUE,…]",
            help="Only this solver: a name, or path.py:Class for your own. Repeatable. Default: those of FILE.",
        ),
        click.option("--tier", default=None, help="Set of scenes. Default: that of FILE; a first one is of smoke."),
        click.option(
            "--baseline", type=click.Path(dir_okay=False, path_type=Path), default=Path("baselines/smoke.json"),
            show_default=True, metavar="FILE", help="File of accepted numbers.",
        ),
    ):  # fmt: skip
        command = option(command)
    return _limit_options(_jobs_option(command))


@main.command(epilog=GATE_EXIT_CODES)
@_gate_options
@click.option("--foreign", is_flag=True, help="Take a FILE of another version, architecture or operating system.")
@click.option("--against", metavar="REVISION", help="Time every solve against this commit too, in turns, in this job.")
@click.option("--report", type=click.Path(dir_okay=False, path_type=Path), help="Write the tables as Markdown too.")
def check(
    baseline: Path, tier: str | None, solvers: tuple[str, ...], out: Path, foreign: bool, against: str | None,
    report: Path | None, **options: Any,
) -> None:  # fmt: skip
    """Compare energy error, momentum, one-sidedness, symmetry, residuals and counted work with an accepted baseline.

    One-sided, on a logarithm with a floor of 8 eps m: what is rounding may vary, and an error that grew from 2e-9 to
    1e-8 fails. Wall time is compared with another commit only (--against), which is timed in turns with this tree.

    \b
    Examples:
      impactbench check --baseline baselines/smoke.json
      impactbench check --against origin/main --solver qce
      impactbench check --solver my_law.py:MyLaw --baseline my_baseline.json --report check.md
    """  # noqa: D301
    with _explained_errors():
        from harness import baseline as gate
        from harness.environment import describe_environment
        from harness.revision import find_commit
        from reports.gate import gate_markdown, render_gate, render_times

        accepted = gate.read_baseline(baseline)
        gate.check_same_run(accepted, tier=tier or accepted.tier, seed=accepted.seed)
        if not foreign:
            gate.check_same_kind(accepted, describe_environment())
        if against:
            find_commit(against)
        plan = gate.plan_gate(tier=accepted.tier, seed=accepted.seed, solvers=solvers or accepted.solvers)
        chosen = sorted({planned.task.solver for planned in plan}) if solvers else None
        gate.gated_entries(accepted, chosen)
        _measure_gate(out, plan, tier=accepted.tier, seed=accepted.seed, **options)
        with _open(out) as store:
            environment = gate.latest_environment(store)
            comparison = gate.compare(
                accepted, gate.collect(store, plan), environment=environment, solvers=chosen
            )  # fmt: skip
        times = _time_against(against, plan, options["timeout_s"]) if against else None
        if times:
            render_times(times, _console())
        render_gate(comparison, _console())
        if report is not None:
            _write_text(report, gate_markdown(comparison, times))
    sys.exit(EXIT_FAILED_TASKS if comparison.failures or (times and times.slower) else 0)


@main.command(epilog=GATE_EXIT_CODES)
@_gate_options
@click.option("--reason", required=True, help="Why the new numbers are right; it is kept in the file.")
@click.option("--seed", type=click.IntRange(min=0), default=None, help="Base of all seeds. Default: FILE's own, or 0.")
def accept(
    baseline: Path, tier: str | None, seed: int | None, solvers: tuple[str, ...], out: Path, reason: str, **options: Any
) -> None:
    """Accept results as the baseline; what changed by how much is printed, and kept in FILE with the reason.

    With --solver only that solver's numbers are replaced. FILE is written whole or not at all.

    \b
    Examples:
      impactbench accept --reason "QCE sums the work anew after every end"
      impactbench accept --solver my_law.py:MyLaw --baseline my_baseline.json --reason "first baseline"
    """  # noqa: D301
    with _explained_errors():
        from harness import baseline as gate
        from reports.gate import render_gate

        reason = gate.checked_reason(reason)
        old = gate.read_baseline(baseline) if baseline.exists() else None
        tier = tier or (old.tier if old else "smoke")
        seed = seed if seed is not None else old.seed if old else 0
        if old:
            gate.check_same_run(old, tier=tier, seed=seed)
        plan = gate.plan_gate(tier=tier, seed=seed, solvers=solvers or (old.solvers if old else None))
        chosen = sorted({planned.task.solver for planned in plan}) if solvers else None
        _measure_gate(out, plan, tier=tier, seed=seed, **options)
        with _open(out) as store:
            environment = gate.latest_environment(store)
            measured = gate.collect(store, plan)
        new = gate.accept(
            measured, old, plan=plan, tier=tier, seed=seed, solvers=chosen, environment=environment, reason=reason
        )
        if old:
            render_gate(gate.compare(old, new.entries, environment=environment), _console())
        gate.write_baseline(baseline, new)
    click.echo(f"written: {baseline}: {len(new.entries)} solvers × scenes", err=True)


@main.command(epilog=GATE_EXIT_CODES)
@click.argument("earlier", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("later", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--report", type=click.Path(dir_okay=False, path_type=Path), help="Write the tables as Markdown too.")
def compare(earlier: Path, later: Path, report: Path | None) -> None:
    """Compare two results folders of scorecards or runs: what got worse, better, or is missing in LATER.

    As `check` does it, with EARLIER for the baseline: of two commits, two machines, two versions of a library. Nothing
    is measured. What EARLIER has no answer to cannot get worse, and is new.

    \b
    Examples:
      impactbench compare results/before results/after
      impactbench compare results other-machine/results --report compare.md
    """  # noqa: D301
    with _explained_errors():
        from harness import baseline as gate
        from reports.gate import gate_markdown, render_gate

        with _open(earlier) as store:
            accepted = gate.as_baseline(store, f"results in {earlier}")
        with _open(later) as store:
            of_later = gate.as_baseline(store, f"results in {later}")
            gate.check_same_run(accepted, tier=of_later.tier, seed=of_later.seed)
            comparison = gate.compare(accepted, gate.collect(store), environment=gate.latest_environment(store))
        render_gate(comparison, _console())
        if report is not None:
            _write_text(report, gate_markdown(comparison))
    sys.exit(EXIT_FAILED_TASKS if comparison.failures else 0)


def _measure_gate(
    out: Path, plan: list[PlannedTask], *, no_measure: bool, fresh: bool, retry: bool, **options: Any
) -> None:
    """Measure what the gate compares, as far as OUT lacks it; who lost a task is in the table."""
    if no_measure and fresh:
        raise BadInput("--fresh would leave nothing to compare with --no-measure")
    if no_measure and retry:
        raise BadInput("--retry measures, which --no-measure forbids")
    if not no_measure:
        _measure_plan(out, plan, fresh=fresh, retry=retry, **options)


def _time_against(revision: str, plan: list[PlannedTask], timeout_s: float) -> TimeComparison:
    from harness.revision import time_against

    return time_against(revision, plan, timeout_s=timeout_s, on_progress=_say)


def _measure(
    out: Path,
    *,
    solvers: tuple[str, ...],
    scenarios: tuple[str, ...],
    tier: str,
    seed: int,
    **options: Any,
) -> int:
    """Plan and measure; returns the number of tasks without an answer."""
    return _measure_plan(out, _plan(solvers, scenarios, tier, seed), tier=tier, seed=seed, **options)


def _measure_plan(
    out: Path,
    plan: list[PlannedTask],
    *,
    tier: str,
    jobs: int | None,
    seed: int,
    timeout_s: float,
    memory_mb: float,
    fresh: bool,
    retry: bool,
) -> int:
    """Measure what is not done yet of a plan; returns the number of tasks without an answer."""
    from harness.environment import available_cores
    from harness.isolation import Limits
    from harness.run import measure
    from reports.progress import progress_display

    if fresh:
        _set_aside(out)
    workers = jobs or available_cores()
    click.echo(
        f"{len(plan)} tasks: {len({planned.task.solver for planned in plan})} solvers, "
        f"{len({(planned.task.kind, planned.label) for planned in plan})} scenes and sweeps; {workers} at a time; "
        f"results go to {out / 'results.sqlite'}",
        err=True,
    )
    try:
        with _terminated_as_interrupted(), progress_display() as display:
            summary = measure(
                out, plan, seed=seed, jobs=workers, limits=Limits(timeout_s, memory_mb), command=_command_line(),
                tier=tier, on_progress=display, retry=retry,
            )  # fmt: skip
    except KeyboardInterrupt:
        click.echo(
            f"\ninterrupted; what was measured is in {out}. The same command goes on where it stopped:\n"
            f"  {_command_line(without=ONCE)}",
            err=True,
        )
        sys.exit(EXIT_INTERRUPTED)
    _print_summary(out, summary)
    return len(summary.lost)


def _plan(solvers: tuple[str, ...], scenarios: tuple[str, ...], tier: str, seed: int) -> list[PlannedTask]:
    """Turn the user's names into tasks."""
    from harness.run import plan_tasks
    from harness.selection import choose_scenarios, choose_solver, judged_solvers
    from harness.sweeps import SWEEPS

    # A solver that is named twice takes part once.
    chosen = {choice.specification: choice for choice in (choose_solver(name) for name in solvers or judged_solvers())}
    scenes = [choice for name in scenarios for choice in choose_scenarios(name, tuple(SWEEPS))]
    plan = plan_tasks(list(chosen.values()), tier=tier, scenarios=scenes, seed=seed)
    if not plan:
        raise BadInput("nothing to measure: no scene was chosen")
    return plan


def _set_aside(out: Path) -> None:
    from harness.store import set_aside

    aside = set_aside(out)
    if aside is not None:
        click.echo(f"earlier results are now in {aside}", err=True)


def _set_aside_run(folder: Path) -> None:
    from harness.simulation import set_aside_run

    aside = set_aside_run(folder)
    if aside is not None:
        click.echo(f"the earlier run is now in {aside}", err=True)


def _print_summary(out: Path, summary: Summary) -> None:
    """Say what the tasks came to, and name those that were lost."""
    counts = ", ".join(f"{count} {outcome.value}" for outcome, count in summary.outcomes.items())
    click.echo(f"{sum(summary.outcomes.values())} tasks are done: {counts}", err=True)
    for line in summary.lost[:SHOWN_FAILURES]:
        click.secho(f"  {line}", fg="red", err=True)
    if len(summary.lost) > SHOWN_FAILURES:
        more = len(summary.lost) - SHOWN_FAILURES
        click.echo(f"  and {more} more: impactbench export --table tasks --out {out}", err=True)
    if summary.lost:
        click.echo("the same command with --retry measures them again", err=True)


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let a polite kill (a batch system at its time limit) end the run as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _write_reports(out: Path, write: Callable[[Store, Path], list[Path]]) -> None:
    """Print the scorecard, write the reports, and say what was written."""
    from reports.hard_cases import hard_table
    from reports.hard_cases import render_terminal as render_hard_cases
    from reports.tables import render_terminal
    from reports.tables import scorecard as add_up

    with _open(out) as store:
        console = _console()
        if not _only_hard_cases(store):
            render_terminal(add_up(store), console)
        render_hard_cases(hard_table(store), console)
        written = write(store, out)
    click.echo(f"\nmeasured rows: {store.path}\nwritten to {out}:")
    for path in written:
        click.echo(f"  {path.relative_to(out) if path.is_relative_to(out) else path}")


def _name_bench_files(out: Path, written: list[Path]) -> None:
    names = (path.name for path in written if path.suffix in (".md", ".csv", ".png"))
    click.echo(f"written to {out}: {', '.join(names)}")


def _tables_only(store: Store, folder: Path) -> list[Path]:
    from reports.hard_cases import write_hard_cases
    from reports.tables import write_tables

    tables = [] if _only_hard_cases(store) else write_tables(store, folder)
    return [*tables, *write_hard_cases(store, folder)]


def _only_hard_cases(store: Store) -> bool:
    """Hard cases have a table of their own: nothing on the scorecard comes of them."""
    from harness.measurement import Kind

    return set(store.frame("tasks")["kind"]) == {Kind.HARD_CASE.value}


def _tables_and_figures(store: Store, folder: Path) -> list[Path]:
    from harness.environment import available_cores
    from reports.figures import write_figures

    return [*_tables_only(store, folder), *write_figures(store, folder, jobs=available_cores(), progress=_say)]


def _tables_and_what_can_be_drawn(store: Store, folder: Path) -> list[Path]:
    """As `_tables_and_figures`, for results that may be too few for any figure: the card is written all the same."""
    from harness.environment import available_cores
    from reports.figures import write_figures
    from reports.scorecard import ReportError

    tables = _tables_only(store, folder)
    try:
        return [*tables, *write_figures(store, folder, jobs=available_cores(), progress=_say)]
    except ReportError as error:
        _say(f"no figures: {error}")
        return tables


def _say(text: str) -> None:
    """Tell what happens, beside the results."""
    click.echo(text, err=True)


def _list_solvers() -> None:
    from harness.selection import available_solvers, setting_fields

    for name, law in sorted(available_solvers().items()):
        settings = ", ".join(f"{key}={value}" for key, value in setting_fields(law).items())
        _print_entry(name, _first_line(law), settings and f"settings: {settings}")


def _list_scenarios() -> None:
    from scenarios import CATALOG, describe

    for name in CATALOG:
        call, text = describe(name)
        _print_entry(name, text, call)


def _list_moving() -> None:
    from scenarios import describe
    from scenarios.moving import MOVING

    for name in MOVING:
        call, text = describe(name, MOVING)
        _print_entry(name, text, call)


def _list_sweeps() -> None:
    from harness.sweeps import SWEEPS

    for name, sweep in SWEEPS.items():
        _print_entry(name, _first_line(sweep), "")


def _list_tiers() -> None:
    from scenarios.tiers import TIERS

    for name, scenes in TIERS.items():
        families = list(dict.fromkeys(family for family, _ in scenes))
        _print_entry(name, f"{len(scenes)} scenes", f"families: {', '.join(families)}")


def _print_entry(name: str, text: str, detail: str) -> None:
    """One name with its line, and its settings below it."""
    click.echo(f"  {click.style(f'{name:22}', fg='cyan')} {text}")
    if detail:
        click.echo(click.wrap_text(detail, width=110, initial_indent=" " * 25, subsequent_indent=" " * 27))


def _first_line(thing: object) -> str:
    return next(iter((thing.__doc__ or "").strip().splitlines()), "")


def _write_text(path: Path, text: str) -> None:
    from reports.files import write_whole

    write_whole(path, text.encode())
    click.echo(f"written: {path}", err=True)


def _open(out: Path) -> Store:
    from harness.store import Store

    return Store.open(out)


def _console() -> Console:
    """The terminal; a file or a pipe has no width, and gets one that the tables fit into."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=PLAIN_WIDTH)


def _prepare() -> None:
    """Make ready what must be ready before a solver is imported."""
    from harness.environment import ensure_kernel_cache

    ensure_kernel_cache()


@contextmanager
def _explained_errors() -> Iterator[None]:
    """Turn the errors that a user can do something about into one line and exit code 2."""
    _prepare()
    from harness.baseline import BaselineError
    from harness.isolation import IsolationError
    from harness.measurement import InvalidSolution
    from harness.results import ResultsError
    from harness.selection import SelectionError
    from harness.simulation import SimulationError
    from harness.store import StoreError

    try:
        yield
    except (StoreError, SelectionError, ResultsError, IsolationError, BaselineError, SimulationError) as error:
        raise BadInput(str(error)) from error
    except InvalidSolution as error:
        raise click.ClickException(f"invalid answer: {error}") from error
    except KeyboardInterrupt:
        click.echo("interrupted", err=True)
        sys.exit(EXIT_INTERRUPTED)


def _command_line(*, without: Collection[str] = ()) -> str:
    """The command as it was given, for the record; the user's home folder is not part of it."""
    words = [word for word in sys.argv[1:] if word not in without]
    home = os.path.expanduser("~")
    return shlex.join(["impactbench", *(word.replace(home, "~") if len(home) > 1 else word for word in words)])


if __name__ == "__main__":
    main(prog_name="impactbench")
