"""Simulations: what a run keeps, how it goes on, what it is scored by, and what a user is told."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import impactbench
from harness import trajectory
from harness.measurement import Kind, Verdict
from harness.results import Results
from harness.selection import SelectionError, choose_moving, choose_resolver
from harness.simulation import CHECKPOINT, COLUMNS, MEASURES, STEPS, Schedule, Simulation, SimulationError, State
from harness.simulation import simulate as run_simulation
from harness.store import IncomparableResults, Store, StoreError
from harness.trajectory import Frame, RowWriter, TrajectoryWriter, read_frames, read_table
from reports.comparison import comparison_markdown
from reports.layers import layers_lines, read_layers
from reports.runs import numbers
from reports.simulation import simulation_markdown, write_simulation
from scenarios.world.impact import Streamed
from scenarios.world.stepping import StepReport, World
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
    rows = read_table(folder / STEPS)
    frames = list(read_frames(folder))
    with np.load(folder / CHECKPOINT) as state:
        arrays = {name: state[name].tobytes() for name in state.files}
    return {
        "steps": {name: rows[name].tolist() for name in COLUMNS if name != "wall_s"},
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
    rows = read_table(whole / STEPS)
    assert tuple(rows) == COLUMNS
    assert rows["step"].tolist() == list(range(1, STEPS_MADE + 1))
    assert [frame.step for frame in read_frames(whole)] == list(range(0, STEPS_MADE + 1, 50))
    # They fell on the plate: the scene is not an empty one.
    assert rows["contacts"].max() > 20


@pytest.mark.parametrize("step", [1, 50, 129, 130, 313])
def test_an_interrupted_run_goes_on_bit_for_bit(step: int, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        go(tmp_path, small(), on_step=interrupt_at(step))
    assert len(read_table(tmp_path / STEPS)) == step
    go(tmp_path, small())
    assert kept(tmp_path) == kept(whole)


@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="signals go to the main thread")
@pytest.mark.parametrize("times", [1, 2])
def test_an_interruption_waits_for_the_step_in_progress_and_a_second_one_does_not(
    times: int, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In a compiled call, or between two lines of a step, it would leave the world halfway.
    step = World.step

    def interrupted(world: World) -> StepReport:
        if world.steps == 20:
            for _ in range(times):
                signal.raise_signal(signal.SIGINT)
        return step(world)

    monkeypatch.setattr(World, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        go(tmp_path, small())
    assert len(read_table(tmp_path / STEPS)) == (21 if times == 1 else 20)
    # Afterwards an interruption is what it was.
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
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


def test_a_run_ends_with_a_frame_that_a_longer_run_drops(whole: Path, tmp_path: Path) -> None:
    for _ in range(2):
        go(tmp_path, small(), steps=120)
        assert [frame.step for frame in read_frames(tmp_path)] == [0, 50, 100, 120]
    go(tmp_path, small())
    assert kept(tmp_path) == kept(whole)


def test_energy_is_accounted_for_in_every_step(whole: Path) -> None:
    rows = read_table(whole / STEPS)
    total = rows["kinetic"] + rows["potential"]
    terms = [rows[name] for name in ("impact", "friction", "correction", "shaking", "integration")]
    assert np.diff(total) == pytest.approx(np.sum(terms, axis=0)[1:], abs=1e-9 * total.max())


def test_the_six_scores_come_from_probes_and_from_all_steps(tmp_path: Path) -> None:
    go(tmp_path, small("qce-lcp"), steps=100)
    with Store.open(tmp_path) as store:
        results = Results(store, kinds=(Kind.SIMULATION,))
        cells = {name: results.cell("qce-lcp", name) for name in ("SYM", "KIN", "MOM", "ONE")}
        written = write_simulation(store, tmp_path, choose_moving(SMALL))
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
    assert len(read_table(tmp_path / STEPS)) > 0


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


def test_a_scene_with_a_fixed_step_ends_at_its_duration(tmp_path: Path) -> None:
    specification, law = choose_resolver("qce-lcp-fast")
    scene = choose_moving(SMALL)
    # Ten steps, as sums of steps come out.
    duration = scene.world(solver=law).period * 10 / 300
    simulation = Simulation(scene, specification, law, 0)
    run_simulation(simulation, tmp_path, Schedule(50, 50, 50, duration), command="test")
    assert len(read_table(tmp_path / STEPS)) == 10


@pytest.mark.parametrize("steps", [0, -1])
def test_a_schedule_without_steps_is_refused(steps: int) -> None:
    with pytest.raises(SimulationError, match="frame_every must be at least 1"):
        Schedule(10, steps, 10)


# --- from impact to impact --------------------------------------------------------------------------------------------


def swing(folder: Path, scene: str, solver: str, schedule: Schedule, *, stop_at: int = -1) -> str:
    specification, law = choose_resolver(solver)
    simulation = Simulation(choose_moving(scene), specification, law, 0)
    return run_simulation(simulation, folder, schedule, command="test", on_step=interrupt_at(stop_at))


def cradle_periods(count: float, *, checkpoint_every: int = 1000) -> Schedule:
    return Schedule(1000, 1, checkpoint_every, count * choose_moving("cradle-3d").period)


def verdict_of(folder: Path, name: str) -> Verdict | None:
    with Store.open(folder) as store:
        results = Results(store, kinds=(Kind.SIMULATION,))
        return results.cell(results.solvers[0], name).verdict


def test_frames_from_impact_to_impact_are_at_equal_times_up_to_the_end(tmp_path: Path) -> None:
    assert swing(tmp_path, "cradle-3d", "qce", cradle_periods(2.0)).endswith("is reached after step 4")
    frames, measures = list(read_frames(tmp_path)), read_table(tmp_path / MEASURES)
    apart = choose_moving("cradle-3d").frame_time
    assert [frame.time for frame in frames] == pytest.approx(apart * np.arange(81))
    assert measures["time"].tolist() == [frame.time for frame in frames]
    # Half a period after it was let go the ball at the other end hangs as high, and the first one hangs still.
    assert frames[20].place[:, 2] == pytest.approx(frames[0].place[::-1, 2], abs=1e-6)
    assert frames[20].step == 1


@pytest.mark.parametrize(("scene", "step"), [("cradle-3d", 1), ("cradle-3d", 3), ("pool-break", 1)])
def test_an_interrupted_run_from_impact_to_impact_goes_on_bit_for_bit(scene: str, step: int, tmp_path: Path) -> None:
    schedule = Schedule(5, 1, 2, min(choose_moving(scene).duration, 12.0))
    swing(tmp_path / "whole", scene, "qce", schedule)
    with pytest.raises(KeyboardInterrupt):
        swing(tmp_path / "parts", scene, "qce", schedule, stop_at=step)
    swing(tmp_path / "parts", scene, "qce", schedule)
    assert kept(tmp_path / "parts") == kept(tmp_path / "whole")


def test_an_impact_at_the_start_is_in_the_first_frame_and_in_the_measures(tmp_path: Path) -> None:
    swing(tmp_path, "pool-break:balls=3,approach=0", "qce", Schedule(1, 1, 10))
    (frame,) = read_frames(tmp_path)
    assert (frame.step, frame.time) == (0, 0.0)
    assert len(read_table(tmp_path / MEASURES)) == 1


@pytest.mark.parametrize("stop_at", [2, 4])
def test_a_comparison_of_runs_that_were_gone_on_with_gives_the_share_of_all_their_steps(
    stop_at: int, tmp_path: Path
) -> None:
    scene = "cradle-3d:balls=3"
    for solver in ("qce", "lcp-pgs:max_iterations=1"):
        with pytest.raises(KeyboardInterrupt):
            swing(tmp_path / solver, scene, solver, Schedule(5, 1, 2), stop_at=stop_at)
        swing(tmp_path / solver, scene, solver, Schedule(5, 1, 2))
    runs = {path.name: path for path in sorted(tmp_path.iterdir())}
    page = comparison_markdown(runs, choose_moving(scene))
    for name, folder in runs.items():
        share = 100 * (read_table(folder / STEPS)["status"] == "converged").mean()
        assert re.search(rf"^\| {re.escape(name)} \|.*\| {share:.3g} % \|", page, re.MULTILINE)


def test_energy_kept_is_over_that_before_the_first_step(tmp_path: Path) -> None:
    # Grains that fall lose nothing but what integration adds; the first step's share is in the ledger.
    go(tmp_path, small(), steps=3)
    rows = read_table(tmp_path / STEPS)
    world = choose_moving(SMALL).world(solver="qce-lcp-fast")
    spheres = world.spheres
    kinetic = spheres.kinetic_energy()
    potential = float((spheres.position[:, 2] / spheres.inverse_mass).sum())
    page = comparison_markdown({"a": tmp_path}, choose_moving(SMALL))
    kept_share = float(rows["kinetic"].iloc[-1] + rows["potential"].iloc[-1]) / (kinetic + potential)
    assert f"| {kept_share:.6f} |" in page


def test_a_law_that_lets_all_balls_creep_fails_break_away_over_the_run(tmp_path: Path) -> None:
    for solver in ("qce", "lcp-pgs"):
        swing(tmp_path / solver, "cradle-3d", solver, cradle_periods(2.0))
    assert verdict_of(tmp_path / "qce", "BRK") is Verdict.PASS
    assert verdict_of(tmp_path / "lcp-pgs", "BRK") is Verdict.FAIL


def test_a_run_too_short_to_part_has_no_break_away(tmp_path: Path) -> None:
    swing(tmp_path, "cradle-3d", "qce", cradle_periods(0.01))
    # The raised ball still hangs where it was let go, beside its neighbor that it is to leave: that is apart already.
    measures = read_table(tmp_path / MEASURES)
    assert measures["opening over ideal"].tolist() == pytest.approx([1.0])


def test_a_law_that_breaks_the_symmetry_fails_it_over_the_run(tmp_path: Path) -> None:
    for solver in ("qce", "gauss-seidel"):
        swing(tmp_path / solver, "four-ball-circle", solver, Schedule(20, 1, 1000))
    assert verdict_of(tmp_path / "qce", "SYM") is Verdict.PASS
    assert verdict_of(tmp_path / "gauss-seidel", "SYM") is Verdict.FAIL


def test_a_run_says_why_it_has_no_number(tmp_path: Path) -> None:
    go(tmp_path, small(), steps=60)
    with Store.open(tmp_path) as store:
        page = simulation_markdown(store, numbers(tmp_path / STEPS), choose_moving(SMALL), None)
    assert "| WAV | not applicable | – | a run takes one course" in page
    assert "| SYM | not applicable | – | the packed solver keeps no impulses to judge" in page


def test_measures_may_come_more_often_than_frames(tmp_path: Path) -> None:
    specification, law = choose_resolver("qce-lcp-fast")
    scene = choose_moving(SMALL)
    run_simulation(Simulation(scene, specification, law, 0), tmp_path, Schedule(600, 600, 1000), command="test")
    assert read_table(tmp_path / MEASURES)["step"].tolist() == [0, 300, 600]
    assert [frame.step for frame in read_frames(tmp_path)] == [0, 600]


def test_a_duration_that_is_none_is_refused() -> None:
    with pytest.raises(SimulationError, match="duration must be above 0"):
        Schedule(10, 10, 10, 0.0)


# --- files ------------------------------------------------------------------------------------------------------------


def frame(step: int) -> Frame:
    return Frame(step, 0.1 * step, 0.0, np.full((2, 4), float(step)), np.zeros((2, 3)))


CUTS = (0, 1, 15, 16, 17, 32, 40)


@pytest.mark.parametrize(("written", "kept_frames"), [(w, k) for w in CUTS for k in CUTS if k <= w])
def test_frames_are_cut_back_to_what_a_checkpoint_knows(
    written: int, kept_frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Sixteen frames of two bodies a file.
    monkeypatch.setattr(trajectory, "BODIES_PER_FILE", 32)
    writer = TrajectoryWriter(tmp_path)
    for step in range(written):
        writer.append(frame(step))
    writer.flush()
    again = TrajectoryWriter(tmp_path, frames=kept_frames)
    again.append(frame(1000))
    again.flush()
    assert [f.step for f in read_frames(tmp_path)] == [*range(kept_frames), 1000]


def test_frames_that_are_missing_are_named(tmp_path: Path) -> None:
    writer = TrajectoryWriter(tmp_path)
    writer.append(frame(0))
    writer.flush()
    with pytest.raises(StoreError, match="has 1 frames, fewer than its checkpoint says: 2"):
        TrajectoryWriter(tmp_path, frames=2)


def test_rows_are_cut_back_and_a_torn_one_is_dropped(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    writer = RowWriter(path, ("a", "b"))
    for k in range(4):
        writer.append([k, "x,y"])
    writer.flush()
    path.write_text(path.read_text() + "4,torn")
    RowWriter(path, ("a", "b"), rows=3)
    assert read_table(path).to_dict("list") == {"a": [0, 1, 2], "b": ["x,y"] * 3}


# --- the command ------------------------------------------------------------------------------------------------------


def command(*words: str) -> tuple[int, str]:
    found = CliRunner().invoke(impactbench.main, ["simulate", *words])
    return found.exit_code, found.output


def test_the_command_writes_a_page_with_figures_and_pictures(tmp_path: Path) -> None:
    code, said = command(SMALL, "--steps", "60", "--frames", "30", "--out", str(tmp_path / "run"))
    assert code == 0, said
    assert "The six scores over the run" in said
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"simulation.md", "simulation_energy.pdf", "still-00000.png", "still-00002.png", STEPS} <= names
    # Units are those of the grains.
    page = (tmp_path / "run" / "simulation.md").read_text()
    assert "√(D/g) of simulated time" in page
    assert "mgD" in said


def test_a_fresh_run_starts_anew_and_keeps_the_earlier_one_whole(tmp_path: Path) -> None:
    words = [SMALL, "--steps", "20", "--no-pictures", "--out", str(tmp_path)]
    assert command(*words)[0] == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.suffix in {".npz", ".csv", ".sqlite"}}
    code, said = command(*words, "--fresh")
    assert code == 0, said
    aside = tmp_path / "earlier-1"
    assert str(aside) in said
    assert {path.name: path.read_bytes() for path in aside.iterdir()} == before
    # The same scene made once more: as many rows, not twice as many, and not none.
    assert len(read_table(tmp_path / STEPS)["step"]) == 20
    assert command(*words, "--fresh")[0] == 0
    assert (tmp_path / "earlier-2").is_dir()


def test_the_command_compares_solvers_on_one_scene(tmp_path: Path) -> None:
    words = ["pool-break:balls=3", "--solver", "qce", "--solver", "lcp-pgs", "--no-pictures", "--out", str(tmp_path)]
    code, said = command(*words)
    assert code == 0, said
    page = (tmp_path / "comparison.md").read_text()
    assert page in said
    assert "| qce | 1 | 14 |" in page
    assert "| lcp-pgs |" in page
    names = {path.name for path in tmp_path.iterdir()}
    assert {"comparison_paths.pdf", "comparison_measures.png", "qce", "lcp-pgs"} <= names
    assert (tmp_path / "qce" / "simulation_paths.svg").exists()


def test_runs_are_named_by_what_tells_them_apart() -> None:
    one, two = choose_moving("cradle-3d:balls=5,raised=1"), choose_moving("cradle-3d:balls=5,raised=2")
    assert impactbench._run_name(one, "qce", [one], ["qce", "gr"]) == "qce"
    assert impactbench._run_name(one, "qce", [one, two], []) == "raised=1"
    assert impactbench._run_name(two, "gr", [one, two], ["qce", "gr"]) == "raised=2, gr"


@pytest.mark.long
def test_the_command_compares_members_of_a_family(tmp_path: Path) -> None:
    words = ["cradle-3d:balls=3,raised=1", "cradle-3d:balls=3,raised=2", "--cycles", "1", "--no-pictures"]
    code, said = command(*words, "--out", str(tmp_path))
    assert code == 0, said
    # One ball flies, and two; the qce law keeps the energy of both.
    assert re.search(r"^\| raised=1 \| 2 \|.*\| 1 … 1 \| 1 … 1 \|$", said, re.MULTILINE)
    assert re.search(r"^\| raised=2 \| 2 \|.*\| 1 … 1 \| 2 … 2 \|$", said, re.MULTILINE)
    assert {"raised=1", "raised=2", "comparison.md"} <= {path.name for path in tmp_path.iterdir()}


def test_the_layers_of_a_bed_are_followed_from_where_it_lies(tmp_path: Path) -> None:
    scene = choose_moving("granular-shake")
    place = np.column_stack([np.random.default_rng(0).uniform(0.0, 10.0, (2000, 3)), np.full(2000, 0.5)])
    # Two opposite corners: the floor's size is read off the bodies.
    place[:2, :2] = [[0.0, 0.0], [10.0, 10.0]]
    inner = np.abs(place[:, :2] - 5.0).max(axis=1) < 5.0 / np.sqrt(2.0)
    after = place.copy()
    after[:, 2] += np.where(inner, 0.4, -0.2)
    writer = TrajectoryWriter(tmp_path)
    assert read_layers(tmp_path, scene) is None
    # The first frame is of the fall: it must not count.
    for when, where in ((0.0, 2.0 * place), (scene.color_from, place), (40.0, after)):
        writer.append(Frame(0, when, 0.0, where, np.zeros((2000, 3))))
    writer.flush()
    layers = read_layers(tmp_path, scene)
    assert layers is not None
    lines = list(layers_lines(layers, scene))
    assert "Mean rise between t = 30 and 40 √(D/g) of 10 layers" in lines[2]
    rows = [line for line in lines if re.fullmatch(r"\| [\d.]+ \| \+0\.400 \| -0\.200 \|", line)]
    assert len(rows) == 10
    assert read_layers(tmp_path, choose_moving("pool-break")) is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["extended-patern"], "did you mean extended-pattern"),
        ([SMALL, "--solver", "qcee"], "did you mean qce"),
        ([SMALL, "--steps", "10", "--cycles", "1"], "--steps and --cycles say the same thing"),
        ([SMALL, "--steps", "0"], "--steps"),
        (["pool-break", "cradle-3d"], "several scenes must be members of one family"),
        (["pool-break", "--cycles", "3"], "pool-break has no cycles"),
        (["pool-break", "--solver", "qce", "--solver", "qcee"], "did you mean qce"),
    ],
)
def test_bad_input_exits_with_2_and_one_line(words: list[str], said: str, tmp_path: Path) -> None:
    code, output = command(*words, "--out", str(tmp_path / "run"))
    assert code == 2
    assert said in output
    assert "Traceback" not in output
    assert not (tmp_path / "run").exists()
