"""Time against another commit, measured in the same job: the only comparison of times that a gate can stand on.

A stored time says something of the machine that it was taken on, at that hour. Here both trees are timed by one process
each, in turns, sample by sample: what slows the machine down slows both. The other commit is unpacked by `git archive`
into a temporary folder; nothing is written to the repository.

    ratio of a round = CPU time of a solve here / CPU time of it there      slower where the median > TIME_ALLOWANCE
"""

from __future__ import annotations

import io
import json
import math
import os
import selectors
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np

from harness.baseline import BaselineError
from harness.environment import ROOT
from harness.isolation import SINGLE_THREADED
from harness.store import PlannedTask

# Two copies of one commit, timed on two cores that six other programs kept busy, gave medians from 0.94 to 1.05 over 48
# pairs of solver and scene: five times that spread is no noise.
TIME_ALLOWANCE = 1.25
# Rounds of a pair: an odd number, so that the median is one of them.
ROUNDS = 15
# A solve that takes longer is tried less often: its own length averages the machine [s].
LONG_S, LONG_ROUNDS = 0.1, 5
# A sample is as many solves as take this long, so that the clock's own error does not show [s].
SAMPLE_S, MOST_SOLVES = 0.005, 200


class RevisionError(BaselineError):
    """Another commit cannot be had or timed; the text says why."""


@dataclass(frozen=True)
class TimeRatio:
    """Times of one solver on one scene, here and at the other commit."""

    solver: str
    scene: str
    now_s: float
    """Median CPU time of a solve in this tree [s]; `before_s` at the other commit."""
    before_s: float
    median: float
    """Median over the rounds of this tree's time over the other's; `lower` and `upper` are the quartiles."""
    lower: float
    upper: float


@dataclass(frozen=True)
class TimeComparison:
    """All times against one commit."""

    revision: str
    """The commit, abbreviated."""
    rounds: int
    ratios: tuple[TimeRatio, ...]
    """The slowest first."""
    skipped: tuple[str, ...]
    """Pairs that could not be timed, with the reason."""

    @property
    def slower(self) -> tuple[TimeRatio, ...]:
        """Pairs whose median ratio exceeds the allowance."""
        return tuple(ratio for ratio in self.ratios if ratio.median > TIME_ALLOWANCE)


def time_against(
    revision: str, plan: Sequence[PlannedTask], *, timeout_s: float, on_progress: Callable[[str], None]
) -> TimeComparison:
    """Time every task of a plan in this tree and at another commit, in turns.

    Args:
        revision: any name of a commit that git knows, of the repository around the current folder.
        plan: single impacts.
        timeout_s: longest wait for one sample.
        on_progress: called with a line now and then.

    Raises:
        RevisionError: there is no repository or commit, it does not start, or nothing can be timed in both trees.
    """
    top, commit = _repository(), find_commit(revision)
    with tempfile.TemporaryDirectory(prefix="impactbench-revision-") as folder:
        _unpack(commit, Path(folder))
        on_progress(f"compiling {commit[:12]} and this tree")
        with _Stopwatch(top, top, timeout_s) as here, _Stopwatch(Path(folder), top, timeout_s) as there:
            return _time_in_turns(here, there, plan, commit[:12], on_progress)


def quartiles(ratios: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile."""
    lower, median, upper = np.quantile(ratios, [0.25, 0.5, 0.75])
    return float(lower), float(median), float(upper)


def _time_in_turns(
    here: _Stopwatch, there: _Stopwatch, plan: Sequence[PlannedTask], commit: str, on_progress: Callable[[str], None]
) -> TimeComparison:
    """Warm up, then round by round: a neighbor that comes and goes meets all pairs and both trees."""
    solves: dict[int, int] = {}
    rounds: dict[int, int] = {}
    skipped = []
    for number, planned in enumerate(plan):
        try:
            single = here.time(planned, 1)
            there.time(planned, 1)
        except RevisionError as error:
            skipped.append(f"{planned.task.solver} on {planned.label}: {error}")
            continue
        solves[number] = min(max(math.ceil(SAMPLE_S / max(single, 1e-9)), 1), MOST_SOLVES)
        rounds[number] = ROUNDS if single <= LONG_S else LONG_ROUNDS
    if not solves:
        raise RevisionError(f"nothing could be timed in both trees: {'; '.join(skipped[:3])}")
    samples: dict[int, list[tuple[float, float]]] = {number: [] for number in solves}
    for k in range(ROUNDS):
        on_progress(f"timing, round {k + 1} of {ROUNDS}")
        for number, count in solves.items():
            if k >= rounds[number]:
                continue
            order = (here, there) if k % 2 == 0 else (there, here)
            times = {watch: watch.time(plan[number], count) for watch in order}
            samples[number].append((times[here], times[there]))
    ratios = [_ratio(plan[number], pairs) for number, pairs in samples.items()]
    return TimeComparison(
        commit, ROUNDS, tuple(sorted(ratios, key=lambda ratio: -ratio.median)), tuple(skipped)
    )  # fmt: skip


def _ratio(planned: PlannedTask, pairs: Sequence[tuple[float, float]]) -> TimeRatio:
    """Add the rounds of one pair up."""
    now_s, before_s = (float(np.median(times)) for times in zip(*pairs, strict=True))
    # A clock of coarse steps may read zero for both.
    lower, median, upper = quartiles([now / before if before > 0 else 1.0 for now, before in pairs])
    return TimeRatio(planned.task.solver, planned.label, now_s, before_s, median, lower, upper)


class _Stopwatch:
    """The process that times one tree; a context manager. It is started anew when a solver took it down."""

    def __init__(self, tree: Path, top: Path, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._folder = tree / Path.cwd().resolve().relative_to(top)
        # A repository of somebody's own solver has no laws of ours: then the installed ones are used on both sides.
        self._home = tree if (tree / "solvers" / "solution.py").is_file() else ROOT
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  closed in __exit__
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> _Stopwatch:
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        self._errors.close()

    def time(self, planned: PlannedTask, solves: int) -> float:
        """CPU time of one solve [s], averaged over so many.

        Raises:
            RevisionError: the solver refuses, raises, crashes or takes too long.
        """
        task = planned.task
        request = {
            "solver": task.solver, "scenario": task.scenario, "parameters": dict(task.parameters), "solves": solves
        }  # fmt: skip
        reply = self._ask(json.dumps(request, default=list))
        if "cpu_s" not in reply:
            raise RevisionError(str(reply["reason"]))
        return float(str(reply["cpu_s"]))

    def _start(self) -> None:
        environment = {**dict.fromkeys(SINGLE_THREADED, "1"), **os.environ, "PYTHONPATH": str(self._home)}
        self._errors.seek(0)
        self._errors.truncate()
        self._process = subprocess.Popen(
            # -P: the folder of the script, with its module `statistics`, must not come first on the path.
            [sys.executable, "-P", str(Path(__file__).with_name("stopwatch.py"))],
            cwd=self._folder, env=environment, text=True, encoding="utf-8", bufsize=1,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors,
        )  # fmt: skip
        home = Path(str(self._read().get("home")))
        if home != self._home.resolve():
            raise RevisionError(f"the solvers came from another folder than the tree that was to be timed: {home.name}")

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _ask(self, request: str) -> Mapping[str, object]:
        """Send a request and wait for its reply."""
        if self._process is None:
            self._start()
        assert self._process is not None
        assert self._process.stdin is not None
        # `_read` says what a dead process died of.
        with suppress(BrokenPipeError):
            self._process.stdin.write(request + "\n")
            self._process.stdin.flush()
        return self._read()

    def _read(self) -> Mapping[str, object]:
        """Wait for one reply, so long and no longer."""
        assert self._process is not None
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            if not selector.select(self._timeout_s):
                self._stop()
                raise RevisionError(f"no answer within {self._timeout_s:g} s")
        line = self._process.stdout.readline()
        if not line:
            self._stop()
            raise RevisionError(self._last_words())
        reply: Mapping[str, object] = json.loads(line)
        return reply

    def _last_words(self) -> str:
        """Last line that the process wrote to standard error."""
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else "the process ended without a word"


def _repository() -> Path:
    """Top folder of the repository around the current folder."""
    return Path(_git("rev-parse", "--show-toplevel").decode().strip()).resolve()


def find_commit(revision: str) -> str:
    """Full name of a commit of the repository around the current folder.

    Raises:
        RevisionError: there is no such repository or commit.
    """
    try:
        # A leading dash would be an option of git.
        return _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").decode().strip()
    except RevisionError:
        raise RevisionError(
            f"git knows no commit {revision!r} here; in CI, check out with the whole history (fetch-depth: 0)"
        ) from None


def _unpack(commit: str, folder: Path) -> None:
    """Write the files of a commit into a folder."""
    top = _repository()
    with tarfile.open(fileobj=io.BytesIO(_git("-C", str(top), "archive", "--format=tar", commit))) as archive:
        archive.extractall(folder, filter="data")


def _git(*arguments: str) -> bytes:
    """Output of a git command."""
    try:
        done = subprocess.run(["git", *arguments], capture_output=True, check=True, stdin=subprocess.DEVNULL)
    except FileNotFoundError:
        raise RevisionError("git is not installed: a comparison with another commit needs it") from None
    except subprocess.CalledProcessError as error:
        words = error.stderr.decode("utf-8", "replace").strip() or f"exit code {error.returncode}"
        raise RevisionError(f"git {' '.join(arguments[:2])} failed: {words}") from None
    return done.stdout
