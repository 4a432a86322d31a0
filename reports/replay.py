"""One solver on one scene with all its numbers, on the terminal; solved here, nothing is stored."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from harness.checked import checked_solve
from harness.measure import measure_impact
from harness.measurement import Kind
from harness.run import task_seed
from harness.selection import SolverChoice
from scenarios.scenario import Scenario
from solvers.solution import Floats

# Entries of a vector that are printed.
SHOWN_ENTRIES = 24


def print_replay(choice: SolverChoice, scene: Scenario, seed: int, console: Console) -> None:
    """Solve, measure, and print what came out.

    Args:
        choice: the solver with its settings.
        scene: the impact.
        seed: base of all seeds, as of a run.
        console: where to.

    Raises:
        UnsupportedProblem: the solver refuses the scene.
        InvalidSolution: its answer breaks the contract.
    """
    solution = checked_solve(choice.solver, scene.problem)
    console.print(f"[bold]{choice.specification}[/] on [bold]{scene.label}[/]: {scene.source}", highlight=False)
    console.print(
        f"{solution.status.label} after {solution.iterations} iterations, {solution.visits} contact visits. "
        f"{solution.status.happened}"
    )
    u_post = scene.problem.J @ solution.v_post
    vectors = {"v_pre": scene.problem.v_pre, "v_post": solution.v_post, "u_pre": scene.problem.u_pre, "u_post": u_post}
    if solution.impulse is not None:
        vectors["impulse"] = solution.impulse
    for name, vector in vectors.items():
        console.print(f"{name:8} {_vector(vector)}", highlight=False)
    measured = measure_impact(
        choice.solver, scene, name=choice.name, seed=task_seed(seed, Kind.IMPACT, scene.name, scene.parameters)
    )
    table = Table()
    for heading in ("score", "metric", "value", "tolerance", "verdict", "reference"):
        table.add_column(heading)
    for score in measured.scores:
        table.add_row(
            score.name, score.metric, f"{score.value:.3g}", f"{score.tolerance:.3g}", score.verdict.value,
            score.reference,
        )  # fmt: skip
    console.print(table)


def _vector(vector: Floats) -> str:
    """A vector as text, its middle left out where it is long."""
    numbers = [f"{float(value): .10g}" for value in vector]
    if len(numbers) > SHOWN_ENTRIES:
        half = SHOWN_ENTRIES // 2
        numbers = [*numbers[:half], f" … {len(numbers) - 2 * half} more …", *numbers[-half:]]
    return " ".join(numbers)
