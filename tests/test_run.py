"""What is planned, in what order, with which seeds; and that neither order nor number of workers changes a result."""

from __future__ import annotations

import getpass
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
import pytest

from harness.environment import describe_environment, ensure_kernel_cache
from harness.isolation import Limits
from harness.measurement import Kind, Outcome
from harness.run import FAILURES, Progress, describe, fingerprint, measure, plan_tasks, task_seed
from harness.selection import (
    ScenarioChoice,
    SelectionError,
    SolverChoice,
    build_scenario,
    choose_scenarios,
    choose_solver,
)
from harness.store import IncomparableResults, PlannedTask, Store
from harness.sweeps import SWEEPS
from scenarios import CATALOG
from scenarios.tiers import HARD, TIERS
from solvers import SOLVERS

LIMITS = Limits(timeout_s=100.0)
# What two runs of the same work may differ in: the clock, the memory, and which run it was.
MACHINE_DEPENDENT = ["wall_s", "peak_memory_mb", "run"]


def quick_plan(solvers: Sequence[str] = ("qce", "gauss-seidel"), seed: int = 0) -> list[PlannedTask]:
    scenes = [ScenarioChoice("three-ball-chain", {"va": va}, exact=True) for va in (0.25, 0.5)]
    return plan_tasks([choose_solver(name) for name in solvers], tier="smoke", scenarios=scenes, seed=seed)


def run(
    folder: Path,
    plan: Sequence[PlannedTask],
    *,
    jobs: int = 1,
    seed: int = 0,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> dict[str, pd.DataFrame]:
    measure(folder, plan, seed=seed, jobs=jobs, limits=LIMITS, command="test", tier="smoke", on_progress=on_progress)
    with Store.open(folder) as store:
        return {name: store.frame(name) for name in ("tasks", "scores", "series")}


def same(one: dict[str, pd.DataFrame], other: dict[str, pd.DataFrame]) -> bool:
    return all(
        one[name].drop(columns=MACHINE_DEPENDENT, errors="ignore").equals(
            other[name].drop(columns=MACHINE_DEPENDENT, errors="ignore")
        )
        for name in one
    )  # fmt: skip


@pytest.mark.parametrize("tier", [tier for tier in TIERS if tier != HARD])
def test_a_tier_is_every_sweep_and_every_scene_with_every_solver(tier: str) -> None:
    solvers = [choose_solver(name) for name in ("qce", "gr")]
    plan = plan_tasks(solvers, tier=tier)
    sweeps = [planned for planned in plan if planned.task.kind is Kind.SWEEP]
    scenes = [planned for planned in plan if planned.task.kind is Kind.IMPACT]
    assert {(planned.task.solver, planned.task.scenario) for planned in sweeps} == {
        (solver, sweep) for solver in ("qce", "gr") for sweep in SWEEPS
    }
    labels = {build_scenario(name, parameters).label for name, parameters in TIERS[tier]}
    assert {(planned.task.solver, planned.label) for planned in scenes} == {
        (solver, label) for solver in ("qce", "gr") for label in labels
    }
    assert len(scenes) == 2 * len(labels)


def test_every_member_of_every_tier_builds() -> None:
    for scenes in TIERS.values():
        for name, parameters in scenes:
            assert build_scenario(name, parameters).name == name


def test_a_family_without_parameters_means_the_members_that_the_tier_has() -> None:
    chosen = [choice for name in ("three-ball-chain", "three-ball-chain") for choice in choose_scenarios(name)]
    plan = plan_tasks([choose_solver("qce")], tier="default", scenarios=chosen)
    members = [parameters for name, parameters in TIERS["default"] if name == "three-ball-chain"]
    assert len(plan) == len(members)
    assert {planned.task.kind for planned in plan} == {Kind.IMPACT}


def test_a_family_that_the_tier_does_not_have_takes_part_with_its_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TIERS, "smoke", ())
    plan = plan_tasks([choose_solver("qce")], tier="smoke", scenarios=choose_scenarios("bernoulli"))
    assert [planned.label for planned in plan] == [CATALOG["bernoulli"]().label]


def test_a_sweep_can_be_chosen_alone() -> None:
    plan = plan_tasks([choose_solver("qce")], tier="smoke", scenarios=choose_scenarios("wave", SWEEPS))
    assert [(planned.task.kind, planned.task.scenario) for planned in plan] == [(Kind.SWEEP, "wave")]


def test_naming_a_default_makes_no_other_task() -> None:
    plain, named = (
        plan_tasks([choose_solver("qce")], tier="smoke", scenarios=choose_scenarios(specification))
        for specification in ("bernoulli:mass_ratio=1", "bernoulli:mass_ratio=1.0,friction=0")
    )
    assert plain == named


def test_seeds_come_from_the_scene_and_are_the_same_for_every_solver() -> None:
    seeds = {(planned.label, planned.task.solver): planned.task.seed for planned in quick_plan()}
    assert len(seeds) == 4
    for label in {label for label, _ in seeds}:
        assert seeds[label, "qce"] == seeds[label, "gauss-seidel"]
    assert len(set(seeds.values())) == 2
    assert task_seed(0, Kind.IMPACT, "x", {"a": 1, "b": 2}) == task_seed(0, Kind.IMPACT, "x", {"b": 2, "a": 1})
    assert task_seed(0, Kind.IMPACT, "x", {}) != task_seed(1, Kind.IMPACT, "x", {})
    assert task_seed(0, Kind.IMPACT, "x", {}) != task_seed(0, Kind.SWEEP, "x", {})


def test_an_unknown_tier_is_named_with_the_near_ones() -> None:
    with pytest.raises(SelectionError, match="did you mean smoke"):
        plan_tasks([choose_solver("qce")], tier="smok")


def test_one_worker_and_two_measure_the_same_to_the_last_bit(tmp_path: Path) -> None:
    alone = run(tmp_path / "alone", quick_plan(), jobs=1)
    assert len(alone["scores"]) > 40
    assert same(alone, run(tmp_path / "together", quick_plan(), jobs=2))


def test_another_seed_measures_other_disturbances(tmp_path: Path) -> None:
    one = run(tmp_path / "one", quick_plan(["qce"]))
    other = run(tmp_path / "other", quick_plan(["qce"], seed=1), seed=1)
    robustness = [frames["scores"].query("name == 'robustness'")["value"].tolist() for frames in (one, other)]
    assert robustness[0]
    assert robustness[0] != robustness[1]


def test_a_second_run_measures_nothing_again_and_adds_what_is_new(tmp_path: Path) -> None:
    states: list[Progress] = []
    first = run(tmp_path, quick_plan(["qce"]))
    again = run(tmp_path, quick_plan(["qce"]), on_progress=states.append)
    assert same(first, again)
    assert (first["tasks"]["wall_s"] == again["tasks"]["wall_s"]).all()
    assert [(state.done, state.total) for state in states] == [(2, 2)]
    more = run(tmp_path, quick_plan(["qce", "gauss-seidel"]))
    assert len(more["tasks"]) == 4
    assert (more["tasks"]["wall_s"][:2] == first["tasks"]["wall_s"]).all()


def test_what_another_plan_left_open_stays_open(tmp_path: Path) -> None:
    environment = describe_environment()
    with Store.create_or_open(tmp_path, fingerprint(seed=0, limits=LIMITS, environment=environment)) as store:
        store.plan(
            quick_plan(["qce"]), run=store.begin_run(version="", environment=environment, settings={}, command="")
        )
    tasks = run(tmp_path, quick_plan(["gauss-seidel"]))["tasks"]
    assert dict(zip(tasks["solver"], tasks["state"], strict=True)) == {"qce": "planned", "gauss-seidel": "done"}
    assert set(run(tmp_path, quick_plan())["tasks"]["state"]) == {"done"}


def test_progress_counts_up_and_names_what_is_in_hand(tmp_path: Path) -> None:
    states: list[Progress] = []
    run(tmp_path, quick_plan(), on_progress=states.append)
    assert states[0].done == 0
    assert states[0].total == 4
    ended = [describe(state.ended) for state in states if state.ended is not None]
    assert ended[0] == "qce on three-ball-chain(va=0.25)"
    assert len(ended) == len(set(ended)) == 4
    assert max(state.done for state in states) == 4
    assert all(len(state.in_hand) <= 1 for state in states)


def test_results_of_another_seed_or_limit_are_not_mixed_in(tmp_path: Path) -> None:
    run(tmp_path, quick_plan(["qce"]))
    with pytest.raises(IncomparableResults, match="seed: stored 0, now 5"):
        run(tmp_path, quick_plan(["qce"], seed=5), seed=5)
    with pytest.raises(IncomparableResults, match=r"timeout_s: stored 100.0, now 1"):
        measure(
            tmp_path, quick_plan(["qce"]), seed=0, jobs=1, limits=Limits(timeout_s=1.0), command="test", tier="smoke",
            on_progress=lambda progress: None,
        )  # fmt: skip


def test_an_edited_solver_file_is_another_solver(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    def choice(reason: str) -> SolverChoice:
        path = user_file(f"""
            class Refuses:
                def solve(self, problem):
                    raise UnsupportedProblem({reason!r})
        """)
        return choose_solver(f"{path}:Refuses")

    scene = [ScenarioChoice("three-ball-chain", {"va": 0.5}, exact=True)]
    first = run(tmp_path / "out", plan_tasks([choice("old")], tier="smoke", scenarios=scene))
    assert list(first["tasks"]["reason"]) == ["old"]
    with pytest.raises(IncomparableResults, match="source: stored"):
        run(tmp_path / "out", plan_tasks([choice("new")], tier="smoke", scenarios=scene))


def test_failures_are_all_but_answers_and_refusals() -> None:
    assert set(Outcome) - set(FAILURES) == {Outcome.MEASURED, Outcome.REFUSED}


def test_the_environment_names_no_user_no_host_and_no_folder() -> None:
    text = " ".join(str(value) for value in describe_environment().values())
    assert platform.node() not in text.split()
    assert f"/{getpass.getuser()}" not in text
    assert str(Path.cwd()) not in text


def test_the_fingerprint_has_code_arithmetic_seed_and_limits() -> None:
    known = fingerprint(seed=3, limits=LIMITS, environment=describe_environment())
    assert {"impactbench", "source", "numpy", "scipy", "numba", "cpu", "seed", "timeout_s", "memory_mb"} <= set(known)
    assert None not in known.values()


def test_kernels_have_a_private_cache_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    # Folders below a file cannot be made by anybody, root included.
    monkeypatch.setattr("harness.environment.ROOT", tmp_path / "file")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    ensure_kernel_cache()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.stat().st_mode & 0o077 == 0


def test_a_cache_folder_of_the_users_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere")
    ensure_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "/somewhere"


def test_every_registered_solver_can_be_chosen_and_states_its_settings() -> None:
    for name in SOLVERS:
        choice = choose_solver(name)
        assert choice.specification == choice.name == name
        assert "source" not in choice.settings
