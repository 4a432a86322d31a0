"""The bench report on a store made by hand: what is said of costs, growth, failures and noise."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from harness.measurement import Kind, Measurement, Outcome, Score, Series, Task, shown
from harness.store import Ending, PlannedTask, Store
from harness.work_precision import COLD, ERRORS, SCALING, TIMES, VERIFICATION, WARM
from reports.bench import NOT_REACHED, bench_markdown, write_bench
from reports.bench_figures import figures
from reports.bench_rows import Bench, cost_matrix, exponent, is_own_reference, laws, reach, scenes, sweep
from reports.scorecard import ReportError

QUIET_S = 2e-3
HERTZ = "validation: Hertz"


class Making:
    """Fills a store with a bench of numbers chosen here."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = Store.create_or_open(folder, {"results of": "bench"})
        self.run = self.store.begin_run(version="0", environment={"cpu": "made by hand"}, settings={}, command="test")

    def task(
        self, run: str, law: str, scene: str, *, value: float | None = None, contacts: int = 2, round: int = 0,
        parameters: Mapping[str, object] | None = None, tags: frozenset[str] = frozenset(),
    ) -> int:  # fmt: skip
        solver = law if value is None else f"{law}:tolerance={value:g}"
        given: dict[str, object] = {
            "scene": scene, "parameters": dict(parameters or {}), "law": law, "contacts": contacts, "round": round,
            "field": "" if value is None else "tolerance", "value": value,
        }  # fmt: skip
        label = f"{scene}({', '.join(f'{key}={entry}' for key, entry in (parameters or {}).items())})"
        planned = PlannedTask(Task(Kind.SWEEP, solver, run, given, 0), {}, label, tags)
        return self.store.plan([planned], run=self.run)[0]

    def record(self, number: int, measured: Measurement | None, outcome: Outcome = Outcome.MEASURED) -> None:
        reason = "" if measured else "killed at the time limit of 3 s"
        self.store.record(number, Ending(outcome, reason, 1.0, 100.0, measured), run=self.run)

    def errors(self, law: str, scene: str, value: float, error: float, visits: int, truth: float = 0.3) -> None:
        scores: tuple[Score, ...] = (
            shown("error", VERIFICATION, error),
            shown("error", HERTZ, truth, "Hertz", {"uncertainty": 1e-9}),
        )
        number = self.task(ERRORS, law, scene, value=value)
        self.record(number, Measurement("converged", 1, visits, scores))

    def times(
        self, run: str, law: str, scene: str, seconds: float, *, calibration_s: float = QUIET_S,
        status: str = "converged", visits: int = 10, **task: object,
    ) -> None:  # fmt: skip
        columns = {
            "cpu_s": [seconds] * 3, "wall_s": [seconds] * 3, "solves": 1, "fresh_s": 2 * seconds,
            "memory_bytes": 2.0**20, "calibration_s": [calibration_s] * 2, "m": 2, "n": 3,
        }  # fmt: skip
        score = shown("time", "median CPU time", seconds)
        number = self.task(run, law, scene, **task)  # type: ignore[arg-type]
        self.record(number, Measurement(status, 1, visits, (score,), (Series(TIMES, columns),)))

    def precision(self) -> None:
        """Two laws on two scenes: one reaches 1e-8 on both, the other 1e-4 on the first alone."""
        for scene, factor in (("chain", 1.0), ("rack", 10.0)):
            for value, error, seconds, visits in ((1e-2, 1e-2, 1e-3, 100), (1e-8, 1e-8, 1e-2, 1000)):
                self.errors("qce", scene, value, error, visits)
                for k in range(2):
                    self.times(TIMES, "qce", scene, factor * seconds, value=value, round=k)
            self.errors("gr", scene, 1e-2, 1e-4 if scene == "chain" else 0.5, 50)
            self.times(TIMES, "gr", scene, 1e-4, value=1e-2)

    def growth(self) -> None:
        """QCE grows with the power 1.5 of the contacts; GR takes three times as long and is lost at the largest."""
        for contacts in (100, 400, 1600):
            for k in range(2):
                task: dict[str, object] = {
                    "contacts": contacts, "round": k, "parameters": {"spheres": contacts}, "tags": frozenset({"pack"}),
                }  # fmt: skip
                seconds = 1e-6 * contacts**1.5
                self.times(SCALING, "qce", "sphere-pack", seconds, **task)  # type: ignore[arg-type]
                if contacts < 1600:
                    self.times(SCALING, "gr", "sphere-pack", 3 * seconds, visits=130, **task)  # type: ignore[arg-type]
                else:
                    number = self.task(SCALING, "gr", "sphere-pack", **task)  # type: ignore[arg-type]
                    self.record(number, None, Outcome.TIMED_OUT)

    def growth_of(self, law: str, *, status: str = "converged") -> None:
        """One law over three sizes, one round."""
        for contacts in (10, 100, 1000):
            self.times(
                SCALING, law, "sphere-pack", 1e-6 * contacts, status=status, contacts=contacts,
                parameters={"spheres": contacts},
            )  # fmt: skip

    def first_solves(self) -> None:
        columns = {"first_s": 0.25, "second_s": 1e-4}
        self.record(self.task(COLD, "qce", "chain"), Measurement("", 0, 0, (), (Series(COLD, columns),)))

    def warm(self) -> None:
        """Three steps, four times as fast and with half of the visits from the last impulse."""
        for k in range(2):
            columns = {
                "cold_s": [0.2, 0.1, 0.1], "warm_s": [0.05, 0.03, 0.02], "cold_visits": [100, 60, 40],
                "warm_visits": [50, 30, 20], "difference": 1e-11, "statuses": ["converged"],
            }  # fmt: skip
            number = self.task(WARM, "lcp-pgs", "layer", round=k)
            self.record(number, Measurement("", 0, 0, (), (Series(WARM, columns),)))


@pytest.fixture
def making(tmp_path: Path) -> Iterator[Making]:
    made = Making(tmp_path / "results")
    with made.store:
        yield made


def page(made: Making) -> str:
    return bench_markdown(Bench(made.store))


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def table_rows(text: str, start: str) -> list[list[str]]:
    """Cells of all table rows whose first cell is this."""
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")
    ]
    return [row for row in cells if row[0] == start]


def test_points_carry_errors_and_times_of_their_own_runs(making: Making) -> None:
    making.precision()
    bench = Bench(making.store)
    assert laws(bench.points) == ["qce", "gr"]
    assert scenes(bench.points) == ["chain()", "rack()"]
    coarse, fine = sweep(bench.points, "qce", "rack()")
    assert (coarse.error(VERIFICATION), fine.error(VERIFICATION)) == (1e-2, 1e-8)
    assert fine.median_s == pytest.approx(0.1)
    assert fine.timed is not None
    assert (fine.timed.repeats.count, sorted(fine.timed.rounds)) == (6, [0, 1])
    assert fine.uncertainties == {HERTZ: 1e-9}


def test_the_cost_of_an_error_lies_between_the_settings_around_it(making: Making) -> None:
    making.precision()
    points = sweep(Bench(making.store).points, "qce", "chain()")
    # Half way from 1e-2 to 1e-8 in decades is half way from 1 ms to 10 ms and from 100 to 1000 visits.
    assert reach(points, VERIFICATION, [1e-5], visits=False)[0] == pytest.approx(1e-3 * math.sqrt(10))
    assert reach(points, VERIFICATION, [1e-5], visits=True)[0] == pytest.approx(100 * math.sqrt(10))


def test_what_is_not_reached_is_said_so(making: Making) -> None:
    making.precision()
    text = page(making)
    chain, rack = [row for row in table_rows(text, "gr") if len(row) == 7][:2]
    assert chain[1:3] == ["≤ 100 µs (50)", "≤ 100 µs (50)"]
    assert set(chain[3:]) == {NOT_REACHED}
    assert set(rack[1:]) == {NOT_REACHED}


def test_a_law_that_fails_everywhere_is_infinite_in_the_profile(making: Making) -> None:
    making.precision()
    where, names, costs = cost_matrix(Bench(making.store), visits=False)
    assert (where, names) == (["chain()", "rack()"], ["qce", "gr"])
    assert costs.shape == (2, 2)
    assert (costs[:, 1] == math.inf).all()


def test_the_exponent_is_fitted_over_converged_sizes(making: Making) -> None:
    making.growth()
    making.times(SCALING, "qce", "sphere-pack", 1e3, status="iteration limit", contacts=6400,
                 parameters={"spheres": 6400})  # fmt: skip
    fit = exponent(point for point in Bench(making.store).scaling if point.law == "qce")
    assert fit is not None
    assert fit.points == 3
    assert fit.exponent == pytest.approx(1.5)


def test_a_round_that_was_lost_is_what_the_size_came_to(making: Making) -> None:
    making.growth()
    last = [point for point in Bench(making.store).scaling if point.law == "gr"][-1]
    assert last.outcome is Outcome.TIMED_OUT
    assert last.timed is None
    text = page(making)
    assert any(row[-1] == "timed out" for row in table_rows(text, "gr"))
    assert "killed at the time limit of 3 s" in text


def test_the_papers_ratio_stands_beside_ours(making: Making) -> None:
    making.growth()
    text = page(making)
    paper = next(row for row in (line.split("|") for line in text.splitlines()) if "Zhang 2015, Hex" in "|".join(row))
    assert [cell.strip() for cell in paper[3:6]] == ["0.25 s", "6.1 s", "24"]
    ours = table_rows(text, "sphere-pack(spheres=100)")[0]
    assert ours[4:] == ["3.00", "3.00 … 3.00", "13.00"]
    assert table_rows(text, "sphere-pack(spheres=1600)")[0][3:5] == ["timed out", NOT_REACHED]


def test_a_slow_calibration_kernel_makes_the_machine_noisy(making: Making) -> None:
    making.precision()
    assert "quiet" in page(making)
    making.times(TIMES, "qce", "loud", 1e-3, calibration_s=2 * QUIET_S, value=1e-2)
    making.times(TIMES, "gr", "loud", 1e-3, calibration_s=2 * QUIET_S, value=1e-2)
    assert "**NOISY MACHINE**" in page(making)


def test_first_solves_are_reported(making: Making) -> None:
    making.first_solves()
    assert table_rows(page(making), "qce") == [["qce", "250 ms", "100 µs", "1"]]


def test_warm_start_is_reported_beside_cold(making: Making) -> None:
    making.warm()
    (row,) = table_rows(page(making), "lcp-pgs")
    assert row[2:] == ["3", "400 ms", "100 ms", "4.00", "200 → 100", "1e-11", "converged"]


def test_an_open_task_makes_the_page_incomplete(making: Making) -> None:
    making.precision()
    making.task(ERRORS, "qce", "open", value=1e-3)
    making.task(SCALING, "qce", "sphere-pack", contacts=100, parameters={"spheres": 100})
    text = page(making)
    assert "**INCOMPLETE: 2 planned tasks are not done.**" in text


def test_an_interrupted_bench_can_be_drawn(making: Making) -> None:
    making.growth()
    # A family of which nothing was timed yet.
    making.task(SCALING, "qce", "newtons-cradle", contacts=100, parameters={"balls": 101})
    figure = figures(Bench(making.store))["bench_scaling"]()
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["(a) sphere-pack, kick"]


def test_hertz_is_not_judged_by_its_own_answer() -> None:
    assert is_own_reference("hertz", HERTZ)
    assert is_own_reference("hertz:steps_per_contact=8", HERTZ)
    assert not is_own_reference("hertz", "validation: ideal exchange")
    assert not is_own_reference("lzb", HERTZ)


def test_tables_and_figures_are_written_with_every_number_in_full(making: Making, tmp_path: Path) -> None:
    making.precision()
    making.growth()
    written = write_bench(making.store, tmp_path)
    assert all(path.stat().st_size > 0 for path in written)
    names = {path.name for path in written}
    for figure in ("bench_precision_1", "bench_precision_2", "bench_scaling", "bench_profile"):
        assert {f"{figure}.{kind}" for kind in ("pdf", "svg", "png")} <= names
    points, costs, sizes = (read(tmp_path / f"bench_{name}.csv") for name in ("points", "reach", "scaling"))
    assert len(points) == 6
    assert {float(row["verification"]) for row in points} == {1e-2, 1e-8, 1e-4, 0.5}
    assert "inf" in {row["cpu_s"] for row in costs}
    assert [row["outcome"] for row in sizes if row["law"] == "gr"][-1] == "timed out"


@pytest.mark.long
def test_the_same_store_gives_the_same_bytes(making: Making, tmp_path: Path) -> None:
    making.precision()
    making.growth()
    first, again = write_bench(making.store, tmp_path / "a"), write_bench(making.store, tmp_path / "b")
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


def test_a_law_that_the_user_brings_is_drawn_beside_those_of_the_registry(making: Making) -> None:
    for law in ("qce", "/home/somebody/my_law.py:MyLaw", "lcp-apgd", "qce-lcp"):
        making.growth_of(law)
    (scaling,) = (draw() for name, draw in figures(Bench(making.store)).items() if name == "bench_scaling")
    _, labels = scaling.axes[0].get_legend_handles_labels()
    drawn = [label for label in labels if label != "exponent 1"]
    assert [label.split()[0] for label in drawn] == ["QCE", "my_law.py:MyLaw"]


def test_who_did_not_converge_is_said_in_words_with_who_solves_the_same_equations(making: Making) -> None:
    making.growth_of("lcp-pgs", status="iteration limit")
    assert "No method solved them at 1,000 contacts." in page(making)
    making.growth_of("lcp-apgd")
    making.growth_of("hertz", status="iteration limit")
    text = page(making)
    missed = "10 contacts (iteration limit), 100 contacts (iteration limit), 1,000 contacts (iteration limit)."
    assert f"- `lcp-pgs` on sphere-pack, kick: {missed} The same equations are solved at 1,000 contacts by " in text
    assert "at 1,000 contacts by lcp-apgd." in text
    assert f"- `hertz` on sphere-pack, kick: {missed}\n" in text
    assert "- `lcp-apgd`" not in text


def test_a_store_without_a_bench_is_refused(making: Making, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="no bench"):
        write_bench(making.store, tmp_path / "report")


def test_a_report_folder_that_cannot_be_made_is_refused(making: Making, tmp_path: Path) -> None:
    making.precision()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ReportError, match="cannot make the report folder"):
        write_bench(making.store, tmp_path / "file" / "report")
