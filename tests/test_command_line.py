"""The command line as a user calls it: help, names, exit codes, and what is written where."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner, Result

import impactbench
from harness.selection import SelectionError, choose_scenarios, choose_solver
from harness.store import FILE_NAME, Store
from scenarios import CATALOG
from solvers import SOLVERS

ROOT = Path(__file__).parent.parent
COMMANDS = (
    "accept", "bench", "check", "claims", "compare", "export", "figures", "list", "patterns", "replay", "run",
    "scorecard", "simulate",
)  # fmt: skip
# Modules that `--help` must not wait for: each takes a tenth of a second or more.
HEAVY = ("numpy", "scipy", "numba", "pandas", "matplotlib", "rich", "pebble")


def call(*arguments: str) -> Result:
    return CliRunner().invoke(impactbench.main, arguments)


def shell(*arguments: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "impactbench", *arguments], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), **variables},
    )  # fmt: skip


REFUSING = """
    @dataclass(frozen=True)
    class Refuses:
        \"\"\"Never answers.\"\"\"

        strictness: float = 1.0
        rounds: int = 3
        label: str = "a"
        loud: bool = False

        def solve(self, problem):
            raise UnsupportedProblem(f"strictness {self.strictness}")

    class Crashes(Refuses):
        def solve(self, problem):
            os.abort()
"""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with one solver on two scenes, made by the command."""
    folder = tmp_path_factory.mktemp("measured")
    done = shell(
        "scorecard", "--tier", "smoke", "--solver", "gauss-seidel", "--scenario", "three-ball-chain:va=0.5",
        "--scenario", "bernoulli", "--no-figures", folder=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (folder / "printed").write_text(done.stdout, encoding="utf-8")
    return folder


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_teaches_by_example(command: str) -> None:
    result = call(*[word for word in (command, "--help") if word])
    assert result.exit_code == 0
    assert f"impactbench {command}".strip() in result.output
    assert "Example" in result.output or "Start here" in result.output


def test_help_lists_every_command_and_nothing_else() -> None:
    assert set(impactbench.main.commands) == set(COMMANDS)
    for command in COMMANDS:
        assert f"\n  {command} " in call("--help").output


@pytest.mark.parametrize("command", ["", "run", "scorecard"])
def test_help_documents_the_exit_codes(command: str) -> None:
    output = call(*[word for word in (command, "--help") if word]).output
    for code in ("  0  ", "  1  ", "  2  ", "  130  "):
        assert code in output


def test_every_command_and_option_of_the_readme_exists() -> None:
    blocks = re.findall(
        r"^```sh$(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    lines = re.findall(r"^impactbench (.+)$", "\n".join(blocks), re.MULTILINE)
    assert len(lines) > 10
    for line in lines:
        name, *words = shlex.split(line, comments=True)
        known = {option for parameter in impactbench.main.commands[name].params for option in parameter.opts}
        known |= {option for parameter in impactbench.main.commands[name].params for option in parameter.secondary_opts}
        assert {word for word in words if word.startswith("--")} <= known, line


def test_help_waits_for_no_heavy_module() -> None:
    program = f"import sys, impactbench; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_version_is_shown() -> None:
    assert call("--version").output.startswith("impactbench ")


def test_the_facade_has_every_name_that_it_promises() -> None:
    assert impactbench.SOLVERS is SOLVERS
    assert impactbench.CATALOG is CATALOG
    for name in impactbench.__all__:
        assert getattr(impactbench, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = impactbench.nonsense


def test_list_shows_every_name_with_a_line_about_it() -> None:
    output = call("list").output
    for name in (*SOLVERS, *CATALOG, "smoke", "default", "full", "wave", "disturbance"):
        assert f"  {name} " in output
    assert "settings: tolerance=" in output
    assert "va=0.5" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "--solver", "qcee"), "unknown solver 'qcee'; did you mean qce"),
        (("run", "--solver", "pgs"), "lcp-pgs"),
        (("run", "--solver", "zzz"), "there are: "),
        (("run", "--solver", "qce:tolerence=1"), "unknown setting 'tolerence'; did you mean tolerance?"),
        (("run", "--solver", "qce:max_iterations=many"), "max_iterations must be of type int, not 'many'"),
        (("run", "--solver", "qce:tolerance"), "write name:key=value"),
        (("run", "--solver", "qce:tolerance=1,tolerance=2"), "given twice"),
        (("run", "--solver", "nowhere.py:Law"), "cannot read the solver file nowhere.py"),
        (("run", "--solver", "nowhere.py"), "name the class too"),
        (("run", "--scenario", "three-bal-chain"), "did you mean three-ball-chain, "),
        (("run", "--scenario", "nothing-*"), "unknown scenario 'nothing-*'"),
        (("run", "--scenario", "three-ball-chain:vb=1"), "unknown parameter 'vb'; did you mean va?"),
        (("run", "--scenario", "three-ball-chain:va=fast"), "va must be of type float, not 'fast'"),
        (("run", "--scenario", "three-ball-chain:va=-1"), "va must lie in [0, 1]"),
        (("run", "--scenario", "wave:n=3"), "is a sweep and takes no parameters"),
        (("run", "--tier", "smokey"), "unknown tier 'smokey'; did you mean smoke?"),
        (("run", "--jobs", "0"), "--jobs"),
        (("run", "--timeout", "0"), "--timeout"),
        (("run", "--memory", "-5"), "--memory"),
        (("scorcard",), "scorcard"),
        (("replay", "qce", "*"), "name one"),
        (("export", "--out", "nowhere"), "no results in nowhere"),
        (("figures", "--out", "nowhere"), "no results in nowhere"),
        (("claims", "--out", "nowhere"), "no results in nowhere"),
    ],
)
def test_bad_input_is_named_and_exits_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = call(*arguments)
    assert result.exit_code == 2, result.output
    assert message in " ".join(result.output.split())
    assert list(tmp_path.iterdir()) == [], "a command that did nothing must leave nothing"


def test_settings_are_converted_by_the_type_of_their_field(user_file: Callable[[str], Path]) -> None:
    path = user_file(REFUSING)
    choice = choose_solver(f"{path}:Refuses:strictness=2,rounds=1e3,label=[b,c],loud=true")
    assert {key: choice.settings[key] for key in ("strictness", "rounds", "label", "loud")} == {
        "strictness": 2.0, "rounds": 1000, "label": "[b,c]", "loud": True,
    }  # fmt: skip
    assert choose_solver(choice.specification).settings == choice.settings
    assert type(choice.settings["strictness"]) is float
    with pytest.raises(SelectionError, match="rounds must be of type int"):
        choose_solver(f"{path}:Refuses:rounds=true")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def broken(:", "SyntaxError"),
        ("import nothing_of_that_name", "ModuleNotFoundError"),
        ("class Other:\n    def solve(self, problem): ...", "did you mean"),
        ("Law = 3", "unknown solver class 'Law'"),
    ],
)
def test_a_solver_file_that_does_not_load_is_explained(tmp_path: Path, source: str, message: str) -> None:
    path = tmp_path / "my_law.py"
    path.write_text(source, encoding="utf-8")
    name = "Othr" if "Other" in source else "Law"
    with pytest.raises(SelectionError, match=message):
        choose_solver(f"{path}:{name}")


def test_patterns_choose_families() -> None:
    assert {choice.name for choice in choose_scenarios("*")} == set(CATALOG)
    assert {choice.name for choice in choose_scenarios("three-*")} == {
        name for name in CATALOG if name.startswith("three-")
    }


@pytest.fixture
def other_package(
    tmp_path: Path, user_file: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], None]:
    """Install a package with these entry points, for one test."""
    user_file(REFUSING).rename(tmp_path / "foreign_law.py")
    folder = tmp_path / "other_package-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: other-package\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "foreign_law", raising=False)

    def install(lines: str) -> None:
        (folder / "entry_points.txt").write_text(f"[impactbench.solvers]\n{lines}\n")

    return install


def test_solvers_of_other_packages_are_found_and_replace_none(other_package: Callable[[str], None]) -> None:
    other_package("foreign = foreign_law:Refuses\nqce = foreign_law:Refuses")
    listed = call("list", "solvers").output
    assert "foreign" in listed
    assert listed.count("Never answers.") == 1
    assert "strictness 4.0" in call("replay", "foreign:strictness=4", "bernoulli").output
    assert choose_solver("qce").solver == SOLVERS["qce"]()


def test_a_package_that_does_not_load_is_named_and_hinders_no_other(other_package: Callable[[str], None]) -> None:
    other_package("broken = foreign_law:Nothing")
    for arguments in (("list", "solvers"), ("run", "--solver", "broken")):
        result = call(*arguments)
        assert result.exit_code == 2
        assert "solver broken of another package (foreign_law:Nothing) does not load" in result.output
    assert choose_solver("qce").name == "qce"


def test_the_scorecard_is_printed_and_the_files_are_named(measured: Path) -> None:
    printed = (measured / "printed").read_text(encoding="utf-8")
    assert "gauss-seidel" in printed
    for name in ("WAV", "BRK", "SYM", "KIN", "MOM", "ONE"):
        assert name in printed
    named = printed.rpartition("written to results:")[2].split()
    assert named
    for name in named:
        assert (measured / "results" / name).is_file()


def test_hard_cases_alone_have_their_table_and_no_card(tmp_path: Path) -> None:
    out = str(tmp_path / "hard")
    done = call("scorecard", "--tier", "hard", "--solver", "qce", "--scenario", "ball-in-wedge", "--out", out)
    assert done.exit_code == 0, done.output
    assert "hard_cases.md" in done.output
    assert "store is empty" not in done.output
    assert not (tmp_path / "hard" / "scorecard.md").exists()


def test_figures_are_drawn_from_the_store_alone(measured: Path) -> None:
    before = (measured / "results" / FILE_NAME).read_bytes()
    done = call("figures", "--out", str(measured / "results"))
    assert done.exit_code == 0, done.output
    assert any(path.suffix == ".pdf" for path in (measured / "results").rglob("*"))
    assert (measured / "results" / FILE_NAME).read_bytes() == before


def test_claims_stand_beside_what_was_measured(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    done = call("claims", "--out", str(measured / "results"))
    assert done.exit_code == 0, done.output
    assert "Zhang 2015" in done.output
    assert "not measured" in done.output


def refuse_constant(constant: str) -> None:
    raise AssertionError(f"{constant} is not strict JSON")


def test_export_writes_every_score_as_csv(measured: Path) -> None:
    done = call("export", "--out", str(measured / "results"))
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    with Store.open(measured / "results") as store:
        scores = store.frame("results")
    assert [row["metric"] for row in rows] == list(scores["metric"])
    assert [float(row["value"] or "nan") for row in rows] == pytest.approx(list(scores["value"]), nan_ok=True, rel=0)
    assert json.loads(rows[0]["parameters"]) == scores["parameters"][0]


@pytest.mark.parametrize("table", ["results", "runs", "tasks", "scores", "series"])
def test_export_writes_json_that_every_reader_takes(measured: Path, tmp_path: Path, table: str) -> None:
    target = tmp_path / "table.json"
    done = call("export", "--format", "json", "--table", table, "--to", str(target), "--out", str(measured / "results"))
    assert done.exit_code == 0, done.output
    records = json.loads(target.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    with Store.open(measured / "results") as store:
        assert len(records) == len(store.frame(table)) > 0


def test_export_writes_parquet_with_the_same_numbers(measured: Path) -> None:
    to = measured / "scores.parquet"
    asked = ("export", "--out", str(measured / "results"), "--format", "parquet")
    done = call(*asked, "--table", "scores", "--to", str(to))
    assert done.exit_code == 0, done.output
    with Store.open(measured / "results") as store:
        scores = store.frame("scores")
    read = pd.read_parquet(to)
    assert list(read.columns) == list(scores.columns)
    for column in ("score", "task", "value", "tolerance", "margin"):
        np.testing.assert_array_equal(read[column], scores[column])
    assert [json.loads(text) for text in read["detail"]] == list(scores["detail"])
    nowhere = measured / "nowhere" / "scores.parquet"
    refused = call(*asked, "--to", str(nowhere))
    assert refused.exit_code == 2
    assert f"cannot write {nowhere}" in " ".join(refused.output.split())


def test_parquet_without_its_package_or_a_file_is_refused(measured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = ("export", "--out", str(measured / "results"), "--format", "parquet")
    assert "name a file with --to" in call(*asked).output
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refused = call(*asked, "--to", str(measured / "x.parquet"))
    assert refused.exit_code == 2
    assert "Parquet needs pyarrow" in refused.output
    assert not (measured / "x.parquet").exists()


def test_export_to_a_place_that_cannot_be_written_exits_with_2(measured: Path) -> None:
    done = call("export", "--to", "/nowhere/at/all.csv", "--out", str(measured / "results"))
    assert done.exit_code == 2
    assert "cannot write /nowhere/at/all.csv" in done.output


def test_a_crash_is_reported_and_exits_with_1_each_time(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    path = user_file(REFUSING)
    for _ in ("measured", "resumed"):
        done = call(
            "run", "--solver", f"{path}:Crashes", "--scenario", "bernoulli", "--tier", "smoke",
            "--out", str(tmp_path / "out"),
        )  # fmt: skip
        assert done.exit_code == 1
        assert "crashed: the process was killed by SIGABRT" in done.output


# Mends itself from outside: a solver's file must not change between two calls.
FLAKY = """
    from solvers import SOLVERS

    @dataclass(frozen=True)
    class Flaky:
        def solve(self, problem):
            if not os.path.exists(os.path.join(os.path.dirname(__file__), "mended")):
                os.abort()
            return SOLVERS["qce"]().solve(problem)
"""


def test_retry_measures_what_was_lost_again_and_nothing_else(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    path, out = user_file(FLAKY), tmp_path / "out"
    plan = (
        "run", "--solver", f"{path}:Flaky", "--solver", "gauss-seidel", "--scenario", "bernoulli", "--tier", "smoke",
        "--out", str(out),
    )  # fmt: skip
    lost = call(*plan)
    assert lost.exit_code == 1
    assert {"1 measured", "1 crashed"} <= set(re.findall(r"\d \w+", lost.output))
    assert "--retry measures them again" in lost.output
    path.with_name("mended").touch()
    assert call(*plan).exit_code == 1
    assert call("check", "--no-measure", "--retry", "--out", str(out)).exit_code == 2
    with Store.open(out) as store:
        before = store.frame("tasks").set_index("solver")
    mended = call(*plan, "--retry")
    assert mended.exit_code == 0, mended.output
    assert "2 measured" in mended.output
    with Store.open(out) as store:
        after = store.frame("tasks").set_index("solver")
    assert after["outcome"].tolist() == ["measured", "measured"]
    # The run that measured a task is stored with it.
    assert (after["run"] > before["run"]).sum() == 1
    assert after.loc["gauss-seidel", "wall_s"] == before.loc["gauss-seidel", "wall_s"]


def test_fresh_sets_earlier_results_aside(tmp_path: Path, user_file: Callable[[str], Path]) -> None:
    arguments = (
        "run", "--solver", f"{user_file(REFUSING)}:Refuses", "--scenario", "bernoulli", "--tier", "smoke",
        "--out", str(tmp_path / "out"),
    )  # fmt: skip
    assert call(*arguments).exit_code == 0
    refused = call(*arguments, "--seed", "3")
    assert refused.exit_code == 2
    assert "seed: stored 0, now 3" in refused.output
    assert "--fresh" in refused.output
    fresh = call(*arguments, "--seed", "3", "--fresh")
    assert fresh.exit_code == 0, fresh.output
    assert (tmp_path / "out" / "results-1.sqlite").is_file()
    assert call(*arguments, "--seed", "3").exit_code == 0


def test_a_corrupt_store_exits_with_2_and_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / FILE_NAME).write_bytes(b"nonsense " * 1000)
    for command in (("run", "--scenario", "bernoulli", "--solver", "qce"), ("figures",), ("claims",), ("export",)):
        result = call(*command, "--out", str(tmp_path / "out"))
        assert result.exit_code == 2
        assert "damaged or not a results file" in " ".join(result.output.split())
    assert (tmp_path / "out" / FILE_NAME).read_bytes() == b"nonsense " * 1000


def test_replay_prints_velocities_and_every_score() -> None:
    result = call("replay", "gauss-seidel", "three-ball-chain:va=0.5")
    assert result.exit_code == 0, result.output
    assert "v_post" in result.output
    for name in ("SYM", "KIN", "MOM", "ONE"):
        assert name in result.output


def test_replay_of_a_refusal_exits_with_1(user_file: Callable[[str], Path]) -> None:
    path = user_file(REFUSING)
    result = call("replay", f"{path}:Refuses", "bernoulli")
    assert result.exit_code == 1
    assert "strictness 1.0" in result.output
