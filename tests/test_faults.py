"""Whatever a solver does to its process, the run goes on and has a row with the reason."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from harness.isolation import Limits
from harness.measurement import Kind
from harness.run import measure, plan_tasks
from harness.selection import ScenarioChoice, choose_solver
from harness.store import Store

ROOT = Path(__file__).parent.parent
SCENE = ScenarioChoice("three-ball-chain", {"va": 0.5}, exact=True)
# Far more than any of these solvers asks for, except the one that never ends.
PATIENT = Limits(timeout_s=100.0, memory_mb=1024.0)
# A hung solver costs the test this long; starting a worker takes a few hundredths of a second.
IMPATIENT = Limits(timeout_s=2.0, memory_mb=1024.0)
# Longest wait for something that takes hundredths of a second on an idle machine.
DEADLINE_S = 60.0

FAULTS = """
    class Law:
        def solve(self, problem):
            zero = np.zeros(problem.m)
            return ImpactSolution(zero, problem.v_after(zero), Status.CONVERGED, 1, problem.m, 0.0)

    class Raises(Law):
        def solve(self, problem):
            raise ArithmeticError("the wheel came off")

    class RaisesUnpicklable(Law):
        def solve(self, problem):
            class Local(Exception):
                def __init__(self, one, two):
                    super().__init__("local trouble")
            raise Local(1, 2)

    class Exits(Law):
        def solve(self, problem):
            sys.exit(0)

    class LeavesWithoutAWord(Law):
        def solve(self, problem):
            os._exit(3)

    class IsKilled(Law):
        def solve(self, problem):
            os.kill(os.getpid(), signal.SIGKILL)

    class Segfaults(Law):
        def solve(self, problem):
            import ctypes
            ctypes.string_at(0)

    class EatsMemory(Law):
        def solve(self, problem):
            hoard = []
            while True:
                hoard.append(np.ones(4_000_000))

    class WrongShape(Law):
        def solve(self, problem):
            return ImpactSolution(np.zeros(problem.m + 1), problem.v_pre, Status.CONVERGED, 1, 1)

    class NotANumber(Law):
        def solve(self, problem):
            return ImpactSolution(np.zeros(problem.m), problem.v_pre * np.nan, Status.CONVERGED, 1, 1)

    class NoAnswer(Law):
        def solve(self, problem):
            return None

    class Refuses(Law):
        def solve(self, problem):
            raise UnsupportedProblem("only on Sundays")

    class RecursesForEver(Law):
        def solve(self, problem):
            return self.solve(problem)

    class WritesToTheProblem(Law):
        def solve(self, problem):
            problem.v_pre[0] = 0.0

    class Chatters(Law):
        def solve(self, problem):
            print("x" * 100_000)
            return super().solve(problem)
"""
EXPECTED = {
    "Raises": ("raised", r"ArithmeticError: the wheel came off \(my_law.py:\d+ in solve\)"),
    "RaisesUnpicklable": ("raised", r"Local: local trouble"),
    "Exits": ("raised", r"SystemExit: 0"),
    "LeavesWithoutAWord": ("crashed", r"ended by itself with exit code 3"),
    "IsKilled": ("crashed", r"killed by SIGKILL"),
    "Segfaults": ("crashed", r"killed by SIGSEGV \(so may end, too, .* at a limit of \d+ MiB\)"),
    "EatsMemory": ("out of memory", r"memory limit of 1024 MiB"),
    "WrongShape": ("invalid", r"impulse"),
    "NotANumber": ("invalid", r"v_post"),
    "NoAnswer": ("invalid", r"ImpactSolution"),
    "Refuses": ("refused", r"^only on Sundays$"),
    "RecursesForEver": ("raised", r"RecursionError"),
    "WritesToTheProblem": ("raised", r"read-only"),
    "Chatters": ("measured", r"^$"),
    "Law": ("measured", r"^$"),
}


def measured_by(folder: Path, specifications: list[str], limits: Limits, jobs: int = 2) -> pd.DataFrame:
    plan = plan_tasks(
        [choose_solver(specification) for specification in specifications], tier="smoke", scenarios=[SCENE]
    )
    measure(
        folder, plan, seed=0, jobs=jobs, limits=limits, command="test", tier="smoke", on_progress=lambda _progress: None
    )  # fmt: skip
    with Store.open(folder) as store:
        return store.frame("results")


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory, write_solver: Callable[[Path, str], Path]) -> pd.DataFrame:
    folder = tmp_path_factory.mktemp("faults")
    path = write_solver(folder, FAULTS)
    return measured_by(folder / "results", [f"{path}:{law}" for law in EXPECTED], PATIENT)


@pytest.mark.parametrize("law", EXPECTED)
def test_a_fault_is_a_row_with_its_reason(faulty: pd.DataFrame, law: str) -> None:
    rows = faulty[faulty["solver"].str.endswith(f":{law}")]
    outcome, reason = EXPECTED[law]
    assert set(rows["outcome"]) == {outcome}
    assert rows["reason"].str.contains(reason).all(), rows["reason"].iloc[0]
    assert set(rows["state"]) == {"done"}


def test_faults_leave_no_scores_and_honest_solvers_all_of_theirs(faulty: pd.DataFrame) -> None:
    counts = faulty.groupby(faulty["solver"].str.rpartition(":")[2])["score"].count()
    assert (counts[[law for law, (outcome, _) in EXPECTED.items() if outcome != "measured"]] == 0).all()
    assert counts["Law"] == counts["Chatters"] > 10


def test_a_solver_that_lies_about_convergence_is_measured_and_fails(faulty: pd.DataFrame) -> None:
    rows = faulty[faulty["solver"].str.endswith(":Law")]
    assert set(rows["status"]) == {"converged"}
    assert "fail" in set(rows[rows["name"] == "ONE"]["verdict"])


def test_peak_memory_and_time_are_recorded(faulty: pd.DataFrame) -> None:
    rows = faulty[faulty["solver"].str.endswith(":Law")]
    assert 10 < rows["peak_memory_mb"].iloc[0] < 1024
    assert rows["wall_s"].iloc[0] > 0
    assert math.isnan(faulty[faulty["solver"].str.endswith(":IsKilled")]["peak_memory_mb"].iloc[0])


def test_a_solver_that_hangs_is_killed_and_the_next_one_runs(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    path = user_file("""
        class Sleeps:
            def solve(self, problem):
                time.sleep(10_000)

        class IgnoresSignals:
            def solve(self, problem):
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                while True:
                    pass

        class Refuses:
            def solve(self, problem):
                raise UnsupportedProblem("no")
    """)
    rows = measured_by(
        tmp_path / "out", [f"{path}:{law}" for law in ("Sleeps", "IgnoresSignals", "Refuses")], IMPATIENT
    )
    assert list(rows["outcome"]) == ["timed out", "timed out", "refused"]
    assert list(rows["reason"])[:2] == ["killed at the time limit of 2 s"] * 2
    assert list(rows["wall_s"])[:2] == [2.0, 2.0]


def test_a_leak_is_not_charged_to_the_next_task(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    path = user_file("""
        HOARD = []

        @dataclass(frozen=True)
        class Leaks:
            label: str = "a"

            def solve(self, problem):
                if not HOARD or HOARD[-1][0] != self.label:
                    HOARD.append((self.label, np.ones(40_000_000)))
                raise UnsupportedProblem(str(len(HOARD)))
    """)
    labels = [f"{path}:Leaks:label={label}" for label in "abcde"]
    # One worker, five times 305 MiB under a limit of 500 MiB a task.
    rows = measured_by(tmp_path / "out", labels, Limits(timeout_s=100.0, memory_mb=500.0), jobs=1)
    assert list(rows["reason"]) == ["1", "2", "3", "4", "5"]


def start(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "impactbench", *arguments], cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def run_to_end(arguments: list[str], folder: Path) -> int:
    process = start(arguments, folder)
    process.communicate(timeout=DEADLINE_S)
    return process.returncode


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {DEADLINE_S:g} s for {what}"
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def test_a_law_with_threads_leaves_nothing_behind_for_the_system_to_clean_up(
    tmp_path: Path, user_file: Callable[[str], Path]
) -> None:
    user_file("""
        class Threaded:
            def solve(self, problem):
                import numba

                # It starts them.
                numba.get_num_threads()
                raise UnsupportedProblem("threads")
    """)
    process = start(["run", "--scenario", "three-ball-chain:va=0.5", "--solver", "my_law.py:Threaded", "--out", "out"],
                    tmp_path)  # fmt: skip
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, errors
    assert list(stored(tmp_path)["reason"]) == ["threads"]
    assert "leaked" not in errors


# Notes its process, and holds the run in the middle until the file "go" is there.
HALTING = """
    from pathlib import Path

    @dataclass(frozen=True)
    class Halts:
        label: int = 0

        def solve(self, problem):
            with open("calls", "a") as calls:
                calls.write(f"{self.label}\\n")
            if self.label >= 3 and not Path("go").exists():
                Path("pid").write_text(str(os.getpid()))
                while True:
                    pass
            raise UnsupportedProblem(f"law {self.label}")
"""
HALTING_RUN = [
    "run", "--scenario", "three-ball-chain:va=0.5", "--jobs", "1", "--out", "out",
    *[word for label in range(6) for word in ("--solver", f"my_law.py:Halts:label={label}")],
]  # fmt: skip


def stored(folder: Path) -> pd.DataFrame:
    with Store.open(folder / "out") as store:
        return store.frame("tasks")


def run_until_it_halts(folder: Path) -> subprocess.Popen[str]:
    process = start(HALTING_RUN, folder)
    wait_for(lambda: (folder / "pid").exists() and (folder / "pid").read_text() != "", "the solver that halts")
    wait_for(lambda: (stored(folder)["state"] == "done").sum() == 3, "three rows")
    return process


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_killed_run_leaves_no_process_and_resumes_without_repeating_or_losing_a_row(
    tmp_path: Path, user_file: Callable[[str], Path]
) -> None:
    user_file(HALTING)
    process = run_until_it_halts(tmp_path)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    worker = int((tmp_path / "pid").read_text())
    wait_for(lambda: not is_alive(worker), "the worker's end")
    before = stored(tmp_path)
    assert list(before["state"]) == ["done"] * 3 + ["planned"] * 3
    (tmp_path / "go").touch()
    resumed = start(HALTING_RUN, tmp_path)
    _, errors = resumed.communicate(timeout=DEADLINE_S)
    assert resumed.returncode == 0, errors
    after = stored(tmp_path)
    assert after[:3].equals(before[:3]), "rows of the killed run must stay as they were"
    assert list(after["reason"]) == [f"law {label}" for label in range(6)]
    assert list(after["run"]) == [1, 1, 1, 2, 2, 2]
    assert (tmp_path / "calls").read_text().split() == ["0", "1", "2", "3", "3", "4", "5"]


@pytest.mark.parametrize("interruption", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_what_it_measured_and_says_how_to_go_on(
    tmp_path: Path, user_file: Callable[[str], Path], interruption: signal.Signals
) -> None:
    user_file(HALTING)
    process = run_until_it_halts(tmp_path)
    process.send_signal(interruption)
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130
    assert "goes on where it stopped" in errors
    assert "impactbench run --scenario three-ball-chain:va=0.5" in errors
    assert "Traceback" not in errors
    assert list(stored(tmp_path)["state"]) == ["done"] * 3 + ["planned"] * 3


# The command, on a disk that is full once the first task is stored.
FULL_DISK = """
import resource, sys
import impactbench
from harness.store import Store

record = Store.record

def record_and_fill(store, *arguments, **keywords):
    record(store, *arguments, **keywords)
    size = store.path.with_name(store.path.name + "-wal").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

Store.record = record_and_fill
sys.argv = ["impactbench", *sys.argv[1:]]
impactbench.main()
"""


def test_a_full_disk_ends_the_run_and_keeps_what_was_measured(tmp_path: Path) -> None:
    arguments = ["run", "--solver", "gauss-seidel", "--tier", "smoke", "--scenario", "three-ball-chain"]
    arguments += ["--scenario", "newtons-cradle", "--scenario", "bernoulli", "--jobs", "1", "--out", "out"]
    full = subprocess.run(
        [sys.executable, "-c", FULL_DISK, *arguments], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert full.returncode == 2, full.stderr
    assert "What was measured before is kept" in full.stderr
    assert "Traceback" not in full.stderr
    before = stored(tmp_path)
    assert list(before["state"]) == ["done", "planned", "planned"]
    assert run_to_end(arguments, tmp_path) == 0
    after = stored(tmp_path)
    done = before["state"] == "done"
    assert after[done].equals(before[done])
    assert set(after["kind"]) == {Kind.IMPACT.value}
    assert set(after["outcome"]) == {"measured"}
