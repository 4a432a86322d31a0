"""The bench: what is planned, what a run keeps, what errors mean."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from harness import work_precision
from harness.isolation import Limits
from harness.measurement import Measurement, Outcome
from harness.run import Progress, Summary
from harness.selection import SelectionError, build_scenario, choose_solver
from harness.store import IncomparableResults, PlannedTask, Store, StoreError
from harness.work_precision import (
    APPROACH,
    COLD,
    DIALS,
    ENERGY,
    ERRORS,
    MOMENTUM,
    OWN_EQUATIONS,
    OWN_LIMIT,
    SCALING,
    TIERS,
    TIMES,
    VERIFICATION,
    Dial,
    choose_bench,
    measure_errors,
    plan_bench,
    run_bench,
)
from scenarios import CATALOG
from solvers import SOLVERS
from solvers.hertz import Hertz
from solvers.newton_lcp import NewtonLcp
from solvers.pairwise import GaussSeidel, Jacobi

# What projected Gauss-Seidel reaches when it is told 1e-11: its own residual and the harness's differ by rounding.
PGS_RESIDUAL = 1e-10
SLEEPER = '''
import time
from dataclasses import dataclass
from solvers import UnsupportedProblem

@dataclass(frozen=True)
class Sleeper:
    """A law that takes for ever from three contacts on."""

    def solve(self, problem):
        if problem.m > 2:
            time.sleep(60)
        raise UnsupportedProblem("two contacts at most")
'''


def plan(solvers: Sequence[str], scenarios: Sequence[str] = (), **options: object) -> list[PlannedTask]:
    chosen, scenes = choose_bench(solvers, scenarios)
    return plan_bench(chosen, scenarios=scenes, **options)  # type: ignore[arg-type]


def runs(planned: Sequence[PlannedTask]) -> Counter[str]:
    return Counter(task.task.scenario for task in planned)


def bench(folder: Path, planned: Sequence[PlannedTask], *, timeout_s: float = 60.0) -> Summary:
    return run_bench(
        folder, planned, seed=0, limits=Limits(timeout_s, 1024.0), command="test", on_progress=lambda progress: None
    )


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_a_solver_is_swept_over_its_accuracy_setting() -> None:
    planned = plan(["qce"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=3)
    values = len(DIALS["qce"][0].values)
    assert runs(planned) == {ERRORS: values, TIMES: 3 * values}
    assert {task.settings["tolerance"] for task in planned} == set(DIALS["qce"][0].values)


def test_a_setting_that_the_user_names_is_kept() -> None:
    planned = plan(["qce:tolerance=1e-5"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=1)
    assert runs(planned) == {ERRORS: 1, TIMES: 1}
    assert planned[0].settings["tolerance"] == 1e-5


def test_another_setting_stays_beside_the_swept_one() -> None:
    planned = plan(["qce:max_iterations=7"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=1)
    assert len(planned) > 2
    assert {task.settings["max_iterations"] for task in planned} == {7}
    assert {task.task.parameters["law"] for task in planned} == {"qce:max_iterations=7"}


def test_the_inner_lcp_of_gr_is_tightened_with_the_outer_test() -> None:
    for task in plan(["gr"], ["three-ball-chain:va=0.5"], repeats=1):
        assert float(str(task.settings["inner_tolerance"])) == pytest.approx(
            1e-3 * float(str(task.settings["tolerance"]))
        )


def test_compliant_laws_are_swept_by_what_their_integrator_reads() -> None:
    small = plan(["hertz"], ["three-ball-chain:va=0.5"], repeats=1)
    large = plan(["hertz"], ["sphere-pack:spheres=100"], sizes=[100], repeats=1)
    assert {task.task.parameters["field"] for task in small} == {"tolerance"}
    assert {task.task.parameters["field"] for task in large if task.task.scenario == ERRORS} == {"steps_per_contact"}


def test_every_dial_is_a_setting_of_its_solver() -> None:
    for name, dials in DIALS.items():
        for dial in dials:
            assert len(set(dial.values)) == len(dial.values) > 1
            if name in SOLVERS:
                assert set(dial.factors) <= set(SOLVERS[name].__dataclass_fields__), name  # type: ignore[attr-defined]


@pytest.mark.parametrize(("name", "dial"), [(name, dial) for name, dials in DIALS.items() for dial in dials])
def test_every_dial_changes_the_work(name: str, dial: Dial) -> None:
    # Of both integrators of the compliant laws: the pack has 299 contacts, and struck together no chain is exact.
    scene = ("pool-break",) if dial.most < 299 else ("sphere-pack:spheres=100,start=hot",)
    planned = [task for task in plan([name], scene, tier="smoke", repeats=1) if task.task.scenario == ERRORS]
    assert {task.task.parameters["field"] for task in planned} == {dial.field}
    problem = build_scenario(str(planned[0].task.parameters["scene"]), planned[0].task.parameters["parameters"]).problem  # type: ignore[arg-type]
    coarse, fine = (choose_solver(planned[k].task.solver).solver.solve(problem) for k in (0, -1))
    assert coarse.visits < fine.visits, f"{planned[0].task.solver} works as much as {planned[-1].task.solver}"


def test_scaling_runs_with_default_settings_over_the_sizes_asked_for() -> None:
    planned = [task for task in plan(["qce"], ["sphere-pack"], tier="smoke", sizes=[150, 120], repeats=2)
               if task.task.scenario == SCALING]  # fmt: skip
    assert {task.task.solver for task in planned} == {"qce"}
    sizes = {tuple(sorted(dict(task.task.parameters["parameters"]).items())) for task in planned}  # type: ignore[call-overload]
    assert sizes == {(("spheres", size), *start) for size in (120, 150) for start in ((), (("start", "hot"),))}


def test_a_tier_has_scenes_of_both_kinds_and_sizes_enough_for_an_interval() -> None:
    for extent in TIERS.values():
        assert len(extent.pack_sizes) >= 3
        assert extent.repeats >= 2
        assert {name for name, _ in extent.scenes} >= {"three-ball-chain", "sphere-pack"}


def test_only_the_whole_bench_measures_first_solves() -> None:
    assert runs(plan(["qce"], tier="smoke"))[COLD] == TIERS["smoke"].repeats
    assert COLD not in runs(plan(["qce"], ["three-ball-chain"], tier="smoke"))


def test_the_seed_is_that_of_the_packs() -> None:
    seeded = plan(["qce"], ["sphere-pack:spheres=100"], sizes=[100], repeats=1, seed=3)
    assert all(dict(task.task.parameters["parameters"])["seed"] == 3 for task in seeded)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tier": "smok"}, "did you mean smoke"),
        ({"sizes": [300, 0]}, "sizes must be positive, not 0"),
        ({"sizes": [-5]}, "sizes must be positive"),
        ({"repeats": 0}, "repeats must be positive"),
        ({"sizes": [7]}, "sphere-pack refuses"),
    ],
)
def test_impossible_wishes_are_refused_with_the_reason(options: dict[str, object], message: str) -> None:
    with pytest.raises(SelectionError, match=message):
        plan(["qce"], [], **{"tier": "smoke", **options})


@pytest.mark.parametrize(
    ("solvers", "scenarios", "message"),
    [(["qca"], [], "did you mean"), (["qce"], ["sphere-pak"], "sphere-pack"), (["qce:tolerence=1"], [], "tolerance")],
)
def test_unknown_names_are_refused_with_the_near_ones(
    solvers: Sequence[str], scenarios: Sequence[str], message: str
) -> None:
    with pytest.raises(SelectionError, match=message):
        choose_bench(solvers, scenarios)


def test_errors_come_first_and_repeats_of_all_solvers_alternate() -> None:
    planned = [
        PlannedTask(task.task, task.settings, task.label, task.tags, number)
        for number, task in enumerate(plan(["qce", "gr"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=3))
    ]
    stages = list(work_precision._stages(planned))
    assert [name for name, _ in stages][:1] == [ERRORS]
    timed = [task for name, tasks in stages if name == TIMES for task in tasks]
    rounds = [task.task.parameters["round"] for task in timed]
    assert rounds == sorted(rounds)  # type: ignore[type-var]
    for k in range(3):
        assert {task.task.parameters["law"] for task in timed if task.task.parameters["round"] == k} == {"qce", "gr"}


# --- errors -----------------------------------------------------------------------------------------------------------


def values(measured: Measurement) -> dict[str, float]:
    return {score.metric: score.value for score in measured.scores}


def test_verification_and_validation_are_apart() -> None:
    scene = CATALOG["three-ball-chain"](va=0.5)
    found = values(measure_errors(SOLVERS["lcp-pgs"](), scene))
    assert found[VERIFICATION] == found[OWN_EQUATIONS] < PGS_RESIDUAL
    # physics.md, section 3: the LCP's outcome is a third off the ideal exchange.
    assert found["validation: ideal exchange"] == pytest.approx(1 / 3, abs=PGS_RESIDUAL)


def test_a_loose_setting_is_seen() -> None:
    scene = CATALOG["newtons-cradle"](balls=5)
    exact = SOLVERS["lcp-pgs"]().solve(scene.problem).v_post
    coarse = values(measure_errors(NewtonLcp(tolerance=1e-2), scene, limit=exact))
    fine = values(measure_errors(NewtonLcp(tolerance=1e-6), scene, limit=exact))
    assert coarse[VERIFICATION] > 1e-4
    assert fine[VERIFICATION] < 1e-5
    assert fine[OWN_LIMIT] < coarse[OWN_LIMIT]


def test_the_approach_that_an_elastic_law_leaves_counts_beside_its_energy() -> None:
    scene = CATALOG["newtons-cradle"](balls=5)
    stopped = values(measure_errors(GaussSeidel(max_iterations=1), scene))
    jacobi = values(measure_errors(Jacobi(max_iterations=1), scene))
    assert stopped[VERIFICATION] == max(stopped[OWN_EQUATIONS], stopped[APPROACH])
    assert jacobi[APPROACH] > 0.1
    assert jacobi[VERIFICATION] >= jacobi[APPROACH]


def test_what_newtons_lcp_lets_approach_is_not_its_error() -> None:
    # Contacts that separate before may approach after: u_post + u_pre ≥ 0 holds all the same.
    scene = CATALOG["sphere-pack"](spheres=100, start="hot")
    found = values(measure_errors(SOLVERS["lcp-pgs"](), scene))
    assert found[APPROACH] > 0.1
    assert found[VERIFICATION] < PGS_RESIDUAL


def test_a_law_without_equations_of_its_own_is_measured_against_its_finest_setting() -> None:
    scene = CATALOG["three-ball-chain"](va=0.5)
    fine = SOLVERS["hertz"]().solve(scene.problem).v_post
    alone = values(measure_errors(Hertz(tolerance=1e-4), scene))
    found = values(measure_errors(Hertz(tolerance=1e-4), scene, limit=fine))
    assert math.isnan(alone[VERIFICATION])
    assert found[VERIFICATION] == found[OWN_LIMIT] > 0


def test_energy_and_momentum_are_measured_by_the_harness() -> None:
    found = values(measure_errors(SOLVERS["qce"](), CATALOG["newtons-cradle"](balls=5)))
    assert found[ENERGY] < 1e-12
    assert found[MOMENTUM] < 1e-12


# --- the run ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small bench, measured once."""
    folder = tmp_path_factory.mktemp("bench")
    bench(folder, plan(["qce", "lcp-nnls"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=2))
    return folder


def test_every_task_is_measured_and_stored(measured: Path) -> None:
    with Store.open(measured) as store:
        tasks, series = store.frame("tasks"), store.frame("series")
    assert set(tasks["outcome"]) == {"measured"}
    points = len(DIALS["qce"][0].values) + 1
    assert Counter(tasks["scenario"]) == {ERRORS: points, TIMES: 2 * points}
    assert len(series) == 2 * points
    for columns in series["columns"]:
        assert all(time > 0 for time in columns["cpu_s"])
        assert len(columns["calibration_s"]) == 2
        assert columns["m"] == 2


def test_errors_and_times_are_runs_of_their_own(measured: Path) -> None:
    with Store.open(measured) as store:
        results = store.frame("results")
    assert set(results[results["scenario"] == TIMES]["name"]) == {"time"}
    assert VERIFICATION in set(results[results["scenario"] == ERRORS]["metric"])


def test_a_bench_goes_on_where_it_stopped(measured: Path) -> None:
    seen: list[Progress] = []
    more = plan(["qce", "lcp-nnls"], ["three-ball-chain:va=0.5"], tier="smoke", repeats=3)
    run_bench(measured, more, seed=0, limits=Limits(60.0, 1024.0), command="test", on_progress=seen.append)
    points = len(DIALS["qce"][0].values) + 1
    ended = [progress.ended for progress in seen if progress.ended]
    assert len(ended) == points
    assert {planned.task.parameters["round"] for planned in ended} == {2}


def test_a_bench_does_not_mix_with_other_settings(measured: Path) -> None:
    with pytest.raises(IncomparableResults, match="timeout_s"):
        bench(measured, plan(["qce"], ["three-ball-chain:va=0.5"], tier="smoke"), timeout_s=7.0)


def test_what_timed_out_once_is_not_tried_again(tmp_path: Path) -> None:
    law = tmp_path / "sleeper.py"
    law.write_text(SLEEPER)
    planned = plan([f"{law}:Sleeper"], ["newtons-cradle:balls=5", "three-ball-chain:va=0.5"], tier="smoke", repeats=2)
    planned = [task for task in planned if task.task.scenario in (ERRORS, TIMES)]
    summary = bench(tmp_path / "out", planned, timeout_s=3.0)
    assert summary.outcomes == {Outcome.TIMED_OUT: 3, Outcome.REFUSED: 3}
    assert len(summary.lost) == 1
    with Store.open(tmp_path / "out") as store:
        tasks = store.frame("tasks")
    again = tasks[tasks["scenario"] == TIMES]
    assert all(reason.startswith("not run again after its end on this scene") for reason in again["reason"])
    assert again["wall_s"].isna().all()


def test_a_folder_that_cannot_be_made_is_refused_before_anything_runs(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.raises(StoreError, match="results folder"):
        bench(blocked / "out", plan(["qce"], ["three-ball-chain:va=0.5"], tier="smoke"))


def test_sizes_above_one_that_timed_out_are_passed_over() -> None:
    planned = [task.task for task in plan(["qce"], ["sphere-pack"], tier="smoke", sizes=[100, 200, 400], repeats=1)
               if task.task.scenario == SCALING and "start" not in dict(task.task.parameters["parameters"])]  # type: ignore[call-overload]  # fmt: skip

    class Empty:
        def frame(self, name: str) -> object:
            import pandas as pd

            return pd.DataFrame({"state": []})

    lost = work_precision._Lost(Empty())  # type: ignore[arg-type]
    small, middle, large = planned
    lost.note(SCALING, middle, Outcome.TIMED_OUT, "killed at the time limit of 3 s")
    assert lost.ending_of(PlannedTask(small, {}, "")) is None
    ending = lost.ending_of(PlannedTask(large, {}, ""))
    assert ending is not None
    assert ending.outcome is Outcome.TIMED_OUT
    assert "contacts: killed at the time limit" in ending.reason
    assert np.isnan(ending.wall_s)
