"""The GitHub action: its inputs, and its steps as the runner would run them."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import impactbench

ROOT = Path(__file__).parent.parent
# How the runner calls a step with "shell: bash".
BASH = ("bash", "--noprofile", "--norc", "-eo", "pipefail", "-c")
# What the package is built from.
PARTS = ("solvers", "scenarios", "harness", "reports")
FILES = ("impactbench.py", "pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff")

LAW = """
    @dataclass(frozen=True)
    class FirstContactOnly:
        visits: int = 1

        def solve(self, problem):
            impulse = np.zeros(problem.m)
            if problem.m and problem.u_pre.min() < 0:
                i = problem.u_pre.argmin()
                impulse[i] = -2 * problem.u_pre[i] / problem.W_diagonal[i]
            visits = self.visits * problem.m
            return ImpactSolution(impulse, problem.v_after(impulse), Status.CONVERGED, 1, visits)
"""


def action_script(step: str) -> str:
    """The shell script of one step of action.yml."""
    lines = iter((ROOT / "action.yml").read_text(encoding="utf-8").splitlines())
    for line in lines:
        if line.strip() == f"- name: {step}":
            break
    for line in lines:
        if line.strip() == "run: |":
            break
    return "\n".join(itertools.takewhile(lambda line: line.startswith(" " * 8), lines))


@pytest.mark.parametrize("code", [0, 1, 2])
@pytest.mark.parametrize(
    ("variables", "options"),
    [
        ({}, []),
        ({"SOLVER": "my law.py:MyLaw", "TIER": "smoke"}, ["--solver", "my law.py:MyLaw", "--tier", "smoke"]),
        ({"AGAINST": "$(touch x)"}, ["--against", "$(touch x)"]),
        ({"FOREIGN": "true"}, ["--foreign"]),
        ({"FOREIGN": "false"}, []),
    ],
)
def test_the_action_passes_its_inputs_on_as_they_are_and_ends_as_the_check_does(
    variables: dict[str, str], options: list[str], code: int, tmp_path: Path
) -> None:
    fake = tmp_path / "impactbench"
    fake.write_text(
        f'#!/bin/bash\nprintf "%s\\n" "$@" > called\necho table > "$RUNNER_TEMP/impactbench-check.md"\nexit {code}\n',
        encoding="utf-8",
    )
    fake.chmod(0o755)
    inputs = {"BASELINE": "a b.json", "SOLVER": "", "TIER": "", "AGAINST": ""} | variables
    places = {"RUNNER_TEMP": str(tmp_path), "GITHUB_STEP_SUMMARY": str(tmp_path / "summary")}
    done = subprocess.run(
        [*BASH, action_script("Check")], cwd=tmp_path,
        env=os.environ | inputs | places | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert done.returncode == code
    called = (tmp_path / "called").read_text(encoding="utf-8").splitlines()
    assert called[0] == "check"
    assert called[1:3] == ["--baseline", "a b.json"]
    assert called[-len(options) :] == options if options else "--solver" not in called
    assert (tmp_path / "summary").read_text(encoding="utf-8") == "table\n"
    assert not (tmp_path / "x").exists()
    known = {name for parameter in impactbench.main.commands["check"].params for name in parameter.opts}
    assert {word for word in called if word.startswith("--")} <= known


def test_every_input_of_the_action_is_used_and_every_used_one_is_declared() -> None:
    text = (ROOT / "action.yml").read_text(encoding="utf-8")
    declared = re.findall(r"^  ([a-z-]+):$", text.partition("inputs:")[2].partition("\nruns:")[0], re.MULTILINE)
    used = re.findall(r"\$\{\{ inputs\.([a-z-]+) \}\}", text)
    assert sorted(declared) == sorted(used)
    assert "python -m pip install" in action_script("Install impactbench")
    # Text of a script that comes from an input would be run as a command.
    assert "${{" not in action_script("Check") + action_script("Install impactbench")


@pytest.mark.long
def test_the_steps_install_the_package_and_gate_somebody_elses_solver(
    tmp_path: Path, write_solver: Callable[[Path, str], Path]
) -> None:
    checkout, theirs, venv = (tmp_path / name for name in ("action", "theirs", "venv"))
    for part in PARTS:
        shutil.copytree(ROOT / part, checkout / part, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(ROOT / name, checkout)
    theirs.mkdir()
    write_solver(theirs, LAW)
    # In place of actions/setup-python.
    subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)

    def step(script: str, **variables: str) -> int:
        """Run a shell script in their repository; returns its exit code."""
        places = {"RUNNER_TEMP": str(tmp_path), "GITHUB_STEP_SUMMARY": str(tmp_path / "summary")}
        path = {"PATH": f"{venv / 'bin'}:{os.environ['PATH']}"}
        clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        return subprocess.run([*BASH, script], cwd=theirs, env=clean | places | path | variables).returncode

    def check(solver: str) -> int:
        return step(action_script("Check"), BASELINE="theirs.json", SOLVER=solver, TIER="", AGAINST="")

    def summary() -> str:
        return (tmp_path / "summary").read_text(encoding="utf-8")

    assert step(action_script("Install impactbench"), SOURCE=str(checkout)) == 0
    law = "my_law.py:FirstContactOnly"
    assert step(f"impactbench accept --solver {law} --baseline theirs.json --reason 'first baseline'") == 0
    assert check(law) == 0
    assert "Nothing got worse" in summary()
    # Their next commit: the same answers for twice the visits.
    write_solver(theirs, LAW.replace("visits: int = 1", "visits: int = 2"))
    shutil.rmtree(tmp_path / "impactbench-check")
    assert check(law) == 1
    assert "numbers got worse" in summary()
    assert check("my_law.py:Nobody") == 2
