"""Simulations: what a run keeps, how it goes on, what it is scored by, and what a user is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import impactbench
from harness.measurement import Kind, Verdict
from harness.results import Results
from harness.selection import SelectionError, choose_moving, choose_resolver
from harness.simulation import CHECKPOINT, COLUMNS, MEASURES, STEPS, Schedule, Simulation, SimulationError, State
from harness.simulation import simulate as run_simulation
from harness.store import IncomparableResults, Store
from harness.trajectory import Frame, RowWriter, TrajectoryWriter, read_frames, read_rows
from reports.simulation import write_simulation
from scenarios.world.impact import Streamed
from solvers import SOLVERS, ImpactProblem, ImpactSolution, Solver

SMALL = "extended-pattern:side=4,steps_per_cycle=300"
STEPS_MADE = 450


def small(solver: str = "qce-lcp-fast", *, law: Solver | Streamed | None = None) -> Simulation:
    """96 grains on a vibrating plate, until they have fallen on it and are thrown."""
    specification, chosen = choose_resolver(solver)
    return Simulation(choose_moving(SMALL), specification, law or chosen, 0)


def go(
    folder: Path, simulation: Simulation, *, steps: int = STEPS_MADE, on_step: Callable[[State], None] = lambda _: None
) -> str:
    return run_simulation(simulation, folder, Schedule(steps, 50, 130), command="test", on_step=on_step)


def interrupt_at(step: int) -> Callable[[State], None]:
    def on_step(state: State) -> None:
        if state.report.step == step:
            raise KeyboardInterrupt

    return on_step


def kept(folder: Path) -> dict[str, object]:
    """All that a run leaves behind and that must not depend on when it was interrupted."""
    rows = read_rows(folder / STEPS)
    frames = list(read_frames(folder))
    with np.load(folder / CHECKPOINT) as state:
        arrays = {name: state[name].tobytes() for name in state.files}
    return {
        "steps": {name: rows[name] for name in COLUMNS if name != "wall_s"},
        "measures": (folder / MEASURES).read_text(),
        "frames": [(frame.step, frame.place.tobytes(), frame.velocity.tobytes()) for frame in frames],
        "state": arrays,
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert go(folder, small()) == f"all {STEPS_MADE} steps are made"
    return folder


def test_a_run_keeps_a_row_a_step_and_its_frames(whole: Path) -> None:
    rows = read_rows(whole / STEPS)
    assert tuple(rows) == COLUMNS
    assert rows["step"] == [str(k + 1) for k in range(STEPS_MADE)]
    assert [frame.step for frame in read_frames(whole)] == list(range(0, STEPS_MADE + 1, 50))
    # They fell on the plate: the scene is not an empty one.
    assert max(int(count) for count in rows["contacts"]) > 20


@pytest.mark.parametrize("step", [1, 50, 129, 130, 313])
def test_an_interrupted_run_goes_on_bit_for_bit(step: int, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        go(tmp_path, small(), on_step=interrupt_at(step))
    assert len(read_rows(tmp_path / STEPS)["step"]) == step
    go(tmp_path, small())
    assert kept(tmp_path) == kept(whole)


def test_a_run_killed_between_checkpoints_goes_on_bit_for_bit(whole: Path, tmp_path: Path) -> None:
    go(tmp_path, small(), steps=260)
    early = (tmp_path / CHECKPOINT).read_bytes()
    go(tmp_path, small(), steps=390)
    # As a killed process leaves it: rows and frames of steps that its last checkpoint does not know.
    (tmp_path / CHECKPOINT).write_bytes(early)
    with (tmp_path / STEPS).open("a") as file:
        file.write("391,12.0,")
    go(tmp_path, small())
    assert kept(tmp_path) == kept(whole)


def test_energy_is_accounted_for_in_every_step(whole: Path) -> None:
    rows = {
        name: np.array(values, dtype=float) for name, values in read_rows(whole / STEPS).items() if name != "status"
    }
    total = rows["kinetic"] + rows["potential"]
    terms = [rows[name] for name in ("impact", "friction", "correction", "shaking", "integration")]
    assert np.diff(total) == pytest.approx(np.sum(terms, axis=0)[1:], abs=1e-9 * total.max())


def test_the_six_scores_come_from_probes_and_from_all_steps(tmp_path: Path) -> None:
    go(tmp_path, small("qce-lcp"), steps=100)
    with Store.open(tmp_path) as store:
        results = Results(store, kinds=(Kind.SIMULATION,))
        cells = {name: results.cell("qce-lcp", name) for name in ("SYM", "KIN", "MOM", "ONE")}
        written = write_simulation(store, tmp_path)
    assert cells["KIN"].verdict is Verdict.PASS
    assert all(cell.verdict is not None for cell in cells.values())
    assert (tmp_path / "simulation.md") in written


@dataclass(frozen=True)
class TooMuch:
    """A third more than the impulse that the LCP needs: gains energy."""

    def solve(self, problem: ImpactProblem) -> ImpactSolution:
        found = SOLVERS["qce-lcp"]().solve(problem)
        impulse = 1.3 * found.impulse if found.impulse is not None else np.zeros(problem.m)
        return ImpactSolution(impulse, problem.v_after(impulse), found.status, 1, problem.m)


def test_a_law_that_gains_energy_fails_kin_over_the_run(tmp_path: Path) -> None:
    go(tmp_path, small("qce-lcp", law=TooMuch()), steps=60)
    with Store.open(tmp_path) as store:
        results = Results(store, kinds=(Kind.SIMULATION,))
        assert results.cell("qce-lcp", "KIN").verdict is Verdict.FAIL


def test_a_folder_of_another_run_is_refused_and_left_alone(whole: Path) -> None:
    before = kept(whole)
    with pytest.raises(IncomparableResults, match="solver"):
        go(whole, small("qce-lcp"))
    assert kept(whole) == before


def test_a_solver_that_refuses_ends_the_run_with_its_reason_and_keeps_what_was_made(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=r"step \d+: qce is an elastic law"):
        go(tmp_path, small("qce"))
    assert (tmp_path / CHECKPOINT).exists()


def test_a_step_that_is_too_large_is_named(tmp_path: Path) -> None:
    scene = choose_moving("extended-pattern:side=4,steps_per_cycle=50")
    specification, law = choose_resolver("qce-lcp-fast")
    with pytest.raises(SimulationError, match=r"a shorter step than"):
        go(tmp_path, Simulation(scene, specification, law, 0))
    assert len(read_rows(tmp_path / STEPS)["step"]) > 0


def test_a_broken_checkpoint_is_named(tmp_path: Path) -> None:
    go(tmp_path, small(), steps=100)
    (tmp_path / CHECKPOINT).write_bytes(b"nonsense")
    with pytest.raises(SimulationError, match="not a checkpoint"):
        go(tmp_path, small())


@pytest.mark.parametrize(
    ("specification", "said"),
    [
        ("extended-patern", "did you mean extended-pattern"),
        ("extended-pattern:pattern=spots", "pattern must be"),
        ("extended-pattern:side=two", "must be of type int"),
        ("extended-pattern:sides=4", "did you mean side"),
    ],
)
def test_a_scene_that_does_not_exist_is_named_with_the_near_ones(specification: str, said: str) -> None:
    with pytest.raises(SelectionError, match=said):
        choose_moving(specification)


def test_a_packed_solver_takes_settings() -> None:
    specification, law = choose_resolver("qce-lcp-fast:max_sweeps=20")
    assert specification == "qce-lcp-fast:max_sweeps=20"
    assert isinstance(law, Streamed)
    assert law.max_sweeps == 20
    with pytest.raises(SelectionError, match="did you mean max_sweeps"):
        choose_resolver("qce-lcp-fast:max_sweps=20")


@pytest.mark.parametrize("steps", [0, -1])
def test_a_schedule_without_steps_is_refused(steps: int) -> None:
    with pytest.raises(SimulationError, match="frame_every must be at least 1"):
        Schedule(10, steps, 10)


# --- files ------------------------------------------------------------------------------------------------------------


def frame(step: int) -> Frame:
    return Frame(step, 0.1 * step, 0.0, np.full((2, 4), float(step)), np.zeros((2, 3)))


CUTS = (0, 1, 15, 16, 17, 32, 40)


@pytest.mark.parametrize(("written", "kept_frames"), [(w, k) for w in CUTS for k in CUTS if k <= w])
def test_frames_are_cut_back_to_what_a_checkpoint_knows(written: int, kept_frames: int, tmp_path: Path) -> None:
    writer = TrajectoryWriter(tmp_path)
    for step in range(written):
        writer.append(frame(step))
    again = TrajectoryWriter(tmp_path, frames=kept_frames)
    again.append(frame(1000))
    assert [f.step for f in read_frames(tmp_path)] == [*range(kept_frames), 1000]


def test_rows_are_cut_back_and_a_torn_one_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    writer = RowWriter(path, ("a", "b"))
    for k in range(4):
        writer.append([k, "x,y"])
    writer.flush()
    path.write_text(path.read_text() + "4,torn")
    RowWriter(path, ("a", "b"), rows=3)
    assert read_rows(path) == {"a": ["0", "1", "2"], "b": ["x,y"] * 3}


# --- the command ------------------------------------------------------------------------------------------------------


def command(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(impactbench.main, ["simulate", *words])
    return found.exit_code, found.output


def test_the_command_writes_a_page_with_figures_and_pictures(tmp_path: Path) -> None:
    code, said = command(SMALL, "--steps", "60", "--frames", "30", "--out", str(tmp_path / "run"))
    assert code == 0, said
    assert "The six scores over the run" in said
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"simulation.md", "simulation_energy.pdf", "still-0000000.png", "still-0000060.png", STEPS} <= names


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["extended-patern"], "did you mean extended-pattern"),
        ([SMALL, "--solver", "qcee"], "did you mean qce"),
        ([SMALL, "--steps", "10", "--cycles", "1"], "--steps and --cycles say the same thing"),
        ([SMALL, "--steps", "0"], "--steps"),
    ],
)
def test_bad_input_exits_with_2_and_one_line(words: list[str], said: str, tmp_path: Path) -> None:
    code, output = command(*words, "--out", str(tmp_path / "run"))
    assert code == 2
    assert said in output
    assert "Traceback" not in output
    assert not (tmp_path / "run").exists()
