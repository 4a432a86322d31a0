"""Time against another commit, in a small repository of somebody's own solver."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from harness import revision
from harness.baseline import plan_gate
from harness.revision import LONG_ROUNDS, ROUNDS, RevisionError, TimeComparison, time_against
from harness.store import PlannedTask

LAW = """
    @dataclass(frozen=True)
    class MyLaw:
        \"\"\"Does nothing, WORK times; refuses a scene.\"\"\"

        def solve(self, problem):
            if problem.m == 2:
                raise UnsupportedProblem("two contacts")
            if problem.m == 3:
                sys.exit("three contacts are too many")
            print("must not be taken for a reply")
            total = sum(range(WORK))
            return ImpactSolution(np.zeros(problem.m), problem.v_pre, Status.ITERATION_LIMIT, 0, 0)
"""
# The other commit does a hundred times less: beyond any noise.
LITTLE, MUCH = "2000", "200000"


def git(folder: Path, *arguments: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    subprocess.run(["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True)


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory, write_solver: Callable[[Path, str], Path]) -> Path:
    """A repository whose last commit is fast and whose working tree is slow."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    folder = tmp_path_factory.mktemp("repository")
    git(folder, "init", "--quiet")
    write_solver(folder, LAW.replace("WORK", LITTLE))
    git(folder, "add", "my_law.py")
    git(folder, "commit", "--quiet", "-m", "fast")
    write_solver(folder, LAW.replace("WORK", MUCH))
    return folder


@pytest.fixture(scope="module")
def times(repository: Path) -> TimeComparison:
    """The working tree against its last commit, on scenes that the law solves, refuses, and dies of."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(repository)
        plan = plan_gate(tier="smoke", seed=0, solvers=["my_law.py:MyLaw"])
        chosen = ("three-ball-chain", "bernoulli", "newtons-cradle")
        return time_against(
            "HEAD", [planned for planned in plan if planned.task.scenario in chosen], timeout_s=60,
            on_progress=lambda line: None,
        )  # fmt: skip


def test_a_tree_that_does_a_hundred_times_the_work_is_slower(times: TimeComparison) -> None:
    assert [row.scene for row in times.slower] == ["newtons-cradle(balls=5)"]
    row = times.slower[0]
    assert row.lower <= row.median <= row.upper
    assert row.now_s > row.before_s > 0.0


def test_what_refuses_or_dies_is_named_and_the_rest_is_timed(times: TimeComparison) -> None:
    assert len(times.skipped) == 2
    assert any("refused: two contacts" in line for line in times.skipped)
    assert any("three contacts are too many" in line for line in times.skipped)


def test_the_repository_is_left_as_it_was(repository: Path, times: TimeComparison) -> None:
    shown = subprocess.run(
        ["git", "-C", str(repository), "status", "--porcelain"], capture_output=True, text=True, check=True
    ).stdout.split("\n")
    assert [line for line in shown if line and "__pycache__" not in line] == [" M my_law.py"]
    trees = subprocess.run(
        ["git", "-C", str(repository), "worktree", "list"], capture_output=True, text=True, check=True
    ).stdout
    assert len(trees.splitlines()) == 1


def test_the_median_of_the_rounds_is_one_of_them() -> None:
    assert ROUNDS % 2 == LONG_ROUNDS % 2 == 1


@pytest.mark.parametrize("name", ["no-such-commit", "--help", ""])
def test_an_unknown_commit_is_an_error_that_says_what_to_do(
    name: str, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(repository)
    with pytest.raises(RevisionError, match="git knows no commit"):
        time_against(name, [], timeout_s=10, on_progress=lambda line: None)


class Refusing:
    """A stopwatch that times nothing."""

    def __init__(self, tree: Path, top: Path, timeout_s: float) -> None: ...

    def __enter__(self) -> Refusing:
        return self

    def __exit__(self, *_: object) -> None: ...

    def time(self, planned: PlannedTask, solves: int) -> float:
        raise RevisionError(f"refused: {planned.label}")


def test_nothing_that_can_be_timed_is_an_error(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(repository)
    monkeypatch.setattr(revision, "_Stopwatch", Refusing)
    plan = plan_gate(tier="smoke", seed=0, solvers=["qce"])
    with pytest.raises(RevisionError, match=r"nothing could be timed in both trees: .*refused: three-ball-chain"):
        time_against("HEAD", plan, timeout_s=60, on_progress=lambda line: None)
