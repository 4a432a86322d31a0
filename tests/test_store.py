"""The store keeps what it was given, all of it or nothing, and refuses what it cannot keep."""

from __future__ import annotations

import math
import os
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from harness.measurement import Kind, Measurement, Outcome, Score, Series, Task, Verdict
from harness.store import (
    FILE_NAME,
    SCHEMA_VERSION,
    Ending,
    IncomparableResults,
    PlannedTask,
    Store,
    StoreError,
    set_aside,
)

FINGERPRINT = {"seed": 0, "version": "1"}
NOBODY = 65534


def planned(va: float = 0.5, tolerance: float = 1e-10) -> PlannedTask:
    task = Task(Kind.IMPACT, "qce", "three-ball-chain", {"va": va}, seed=7)
    return PlannedTask(task, {"tolerance": tolerance}, f"three-ball-chain(va={va})", frozenset({"chain"}))


def scored(*values: float) -> Ending:
    scores = tuple(
        Score("KIN", f"number {k}", value, Verdict.SHOWN, detail={"value": value, "array": np.arange(2)})
        for k, value in enumerate(values)
    )
    series = (Series("solution", {"v_post": [1.0, math.nan, math.inf]}),)
    return Ending(Outcome.MEASURED, "", 0.25, 100.0, Measurement("converged", 3, 12, scores, series))


def begun(folder: Path) -> tuple[Store, int]:
    store = Store.create_or_open(folder, FINGERPRINT)
    return store, store.begin_run(version="1", environment={"cpu": "x"}, settings={"seed": 0}, command="impactbench")


@contextmanager
def without_root() -> Iterator[None]:
    """Permissions do not bind root; tests of them act as nobody."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


def test_planned_tasks_are_pending_until_they_are_recorded(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        rows = store.plan([planned(0.25), planned(0.5)], run=run)
        first, second = store.pending()
        assert rows == [first.number, second.number]
        assert first.task == planned(0.25).task
        assert first.tags == {"chain"}
        store.record(first.number, scored(1.0), run=run)
        assert store.pending() == [second]


def test_planning_again_adds_nothing(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        rows = store.plan([planned()], run=run)
        store.record(store.pending()[0].number, scored(1.0), run=run)
        assert store.plan([planned()], run=run) == rows
        assert store.pending() == []


def test_a_recorded_task_is_not_recorded_twice(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned()], run=run)
        number = store.pending()[0].number
        store.record(number, scored(1.0), run=run)
        with pytest.raises(StoreError, match="done already"):
            store.record(number, scored(2.0), run=run)
        assert list(store.frame("scores")["value"]) == [1.0]


def test_numbers_survive_the_round_trip_nan_and_infinity_too(tmp_path: Path) -> None:
    values = [1 / 3, 5e-324, -0.0, math.inf, -math.inf, math.nan, np.float64(1e300)]
    store, run = begun(tmp_path)
    with store:
        store.plan([planned()], run=run)
        store.record(store.pending()[0].number, scored(*values), run=run)
    with Store.open(tmp_path) as store:
        scores = store.frame("scores")
        np.testing.assert_array_equal(scores["value"], values)
        assert np.isnan(scores["tolerance"]).all()
        np.testing.assert_array_equal([detail["value"] for detail in scores["detail"]], values)
        assert scores["detail"][0]["array"] == [0, 1]
        np.testing.assert_array_equal(store.frame("series")["columns"][0]["v_post"], [1.0, math.nan, math.inf])
        task = store.frame("tasks").iloc[0]
        assert (task["outcome"], task["status"], task["iterations"], task["tags"]) == (
            "measured", "converged", 3, ["chain"],
        )  # fmt: skip
        assert store.frame("runs")["environment"][0] == {"cpu": "x"}


def test_rows_have_the_same_numbers_whatever_the_order_of_recording(tmp_path: Path) -> None:
    frames = []
    for folder, order in ((tmp_path / "a", 1), (tmp_path / "b", -1)):
        store, run = begun(folder)
        with store:
            store.plan([planned(0.25), planned(0.5)], run=run)
            for task in store.pending()[::order]:
                store.record(task.number, scored(float(str(task.task.parameters["va"])), 2.0), run=run)
            frames.append(store.frame("scores"))
    assert frames[0].equals(frames[1])


def test_a_task_without_scores_stands_in_the_results_table(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned(0.25), planned(0.5)], run=run)
        store.record(store.pending()[0].number, Ending(Outcome.CRASHED, "SIGSEGV"), run=run)
        results = store.frame("results")
    assert list(results["state"]) == ["done", "planned"]
    assert results["reason"][0] == "SIGSEGV"
    assert results["detail"][0] == {}


def test_other_settings_of_the_run_are_refused_and_named(tmp_path: Path) -> None:
    Store.create_or_open(tmp_path, FINGERPRINT).close()
    with pytest.raises(IncomparableResults, match=r"(?s)seed: stored 0, now 1.*--out.*--fresh"):
        Store.create_or_open(tmp_path, {**FINGERPRINT, "seed": 1})
    Store.create_or_open(tmp_path, FINGERPRINT).close()


def test_other_settings_of_a_solver_are_refused_and_named(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned()], run=run)
        with pytest.raises(IncomparableResults, match="tolerance: stored 1e-10, now 1e-06"):
            store.plan([planned(0.25), planned(0.5, tolerance=1e-6)], run=run)
        assert len(store.pending()) == 1, "a refused plan must leave nothing behind"


@pytest.mark.parametrize("content", [b"not a database at all " * 100, b"SQLite format 3\x00" + b"\xff" * 5000])
def test_a_file_that_is_no_store_is_named_and_left_alone(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    with pytest.raises(StoreError, match="--fresh"):
        Store.create_or_open(tmp_path, FINGERPRINT)
    with pytest.raises(StoreError, match="--fresh"):
        Store.open(tmp_path)
    assert (tmp_path / FILE_NAME).read_bytes() == content


def test_a_damaged_page_is_found_on_opening(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned(k / 1000) for k in range(500)], run=run)
    path = tmp_path / FILE_NAME
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 9000] = b"\x5a" * 9000
    path.write_bytes(content)
    with pytest.raises(StoreError, match="damaged") as caught:
        Store.create_or_open(tmp_path, FINGERPRINT)
    assert "\n" not in str(caught.value), "what SQLite says in many lines is said in one"
    assert path.read_bytes() == content


def test_a_truncated_store_is_found_on_opening(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned(k / 1000) for k in range(500)], run=run)
    path = tmp_path / FILE_NAME
    path.write_bytes(path.read_bytes()[:20_000])
    with pytest.raises(StoreError, match="damaged"):
        Store.open(tmp_path)


def test_another_programs_database_is_not_touched(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as other:
        other.execute("CREATE TABLE tasks (secret TEXT)")
        other.commit()
    before = (tmp_path / FILE_NAME).read_bytes()
    with pytest.raises(StoreError, match="no impactbench store"):
        Store.create_or_open(tmp_path, FINGERPRINT)
    assert (tmp_path / FILE_NAME).read_bytes() == before


def test_a_newer_store_is_not_touched(tmp_path: Path) -> None:
    Store.create_or_open(tmp_path, FINGERPRINT).close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with pytest.raises(StoreError, match="newer impactbench"):
        Store.create_or_open(tmp_path, FINGERPRINT)
    with pytest.raises(StoreError, match="newer impactbench"):
        Store.open(tmp_path)


def test_a_folder_without_a_store_says_how_to_measure(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="impactbench run --out"):
        Store.open(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o555)
        with without_root(), pytest.raises(StoreError, match="cannot write to the results folder"):
            Store.create_or_open(folder, FINGERPRINT)
        with without_root(), pytest.raises(StoreError, match="cannot make the results folder"):
            Store.create_or_open(Path(folder) / "deeper", FINGERPRINT)


def test_results_in_a_read_only_folder_can_be_read() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store, run = begun(folder)
        with store:
            store.plan([planned()], run=run)
        (folder / FILE_NAME).chmod(0o444)
        folder.chmod(0o555)
        with without_root(), Store.open(folder) as store:
            assert len(store.frame("tasks")) == 1
        folder.chmod(0o755)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("mine", encoding="utf-8")
    with pytest.raises(StoreError, match="cannot make the results folder"):
        Store.create_or_open(tmp_path / "results", FINGERPRINT)


def test_a_full_disk_loses_nothing_that_was_measured(tmp_path: Path) -> None:
    store, run = begun(tmp_path)
    with store:
        store.plan([planned(0.25), planned(0.5)], run=run)
        first, second = store.pending()
        store.record(first.number, scored(1.0), run=run)
        pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
        store._connection.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(StoreError, match=r"full.*kept"):
            store.record(second.number, scored(*np.linspace(0, 1, 5000)), run=run)
        assert store.pending() == [second]
    with Store.create_or_open(tmp_path, FINGERPRINT) as store:
        assert list(store.frame("scores")["value"]) == [1.0]
        store.record(second.number, scored(2.0), run=run)
        assert list(store.frame("scores")["value"]) == [1.0, 2.0]


def test_two_runs_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with (
        Store.create_or_open(tmp_path, FINGERPRINT),
        pytest.raises(StoreError, match="another run is writing"),
    ):
        Store.create_or_open(tmp_path, FINGERPRINT)
    Store.create_or_open(tmp_path, FINGERPRINT).close()


def test_a_report_reads_while_a_run_writes(tmp_path: Path) -> None:
    writer, run = begun(tmp_path)
    with writer:
        writer.plan([planned()], run=run)
        with Store.open(tmp_path) as reader:
            writer.record(writer.pending()[0].number, scored(1.0), run=run)
            assert list(reader.frame("scores")["value"]) == [1.0]


def test_setting_aside_keeps_the_old_results(tmp_path: Path) -> None:
    assert set_aside(tmp_path) is None
    for expected in ("results-1.sqlite", "results-2.sqlite"):
        store, run = begun(tmp_path)
        with store:
            store.plan([planned()], run=run)
        aside = set_aside(tmp_path)
        assert aside == tmp_path / expected
        with closing(sqlite3.connect(aside)) as connection:
            assert connection.execute("SELECT count(*) FROM tasks").fetchone() == (1,)
    assert not (tmp_path / FILE_NAME).exists()


def test_a_store_that_is_written_to_is_not_set_aside(tmp_path: Path) -> None:
    with Store.create_or_open(tmp_path, FINGERPRINT), pytest.raises(StoreError, match="another run is writing"):
        set_aside(tmp_path)
