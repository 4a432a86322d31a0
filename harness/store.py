"""The store: one SQLite file a results folder, the only place where harness and reports meet.

    runs    one row a start of the program: environment, settings, command
    tasks   one row a planned piece of work: planned first, done when it ended, however it ended
    scores  one row a number that a task measured
    series  columns of numbers for figures, so that no report solves anything again

A task and all that it measured are written in one transaction, so a run killed at any moment leaves whole tasks only.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Literal

import numpy as np

from harness.measurement import Kind, Measurement, Outcome, Task

if TYPE_CHECKING:
    import pandas as pd

FILE_NAME = "results.sqlite"
LOCK_NAME = ".results.lock"
SCHEMA_VERSION = 1
# "IMPB": tells our files from other SQLite files.
APPLICATION_ID = 0x494D5042
# Rows of a task are numbered from task * 10,000: a report that links to "score 120003" says the same for any --jobs.
ROWS_PER_TASK = 10_000
# A reader (a report drawn meanwhile) holds the file for milliseconds; 10 s means that something is stuck.
BUSY_TIMEOUT_S = 10.0

SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE runs (
    run INTEGER PRIMARY KEY, started TEXT NOT NULL, finished TEXT, version TEXT NOT NULL,
    environment TEXT NOT NULL, settings TEXT NOT NULL, command TEXT NOT NULL);
CREATE TABLE tasks (
    task INTEGER PRIMARY KEY, run INTEGER NOT NULL REFERENCES runs, kind TEXT NOT NULL, solver TEXT NOT NULL,
    settings TEXT NOT NULL, scenario TEXT NOT NULL, parameters TEXT NOT NULL, label TEXT NOT NULL,
    tags TEXT NOT NULL, seed INTEGER NOT NULL, state TEXT NOT NULL CHECK (state IN ('planned', 'done')),
    outcome TEXT, reason TEXT, status TEXT, iterations INTEGER, visits INTEGER, wall_s REAL, peak_memory_mb REAL,
    UNIQUE (kind, solver, scenario, parameters, seed));
CREATE TABLE scores (
    score INTEGER PRIMARY KEY, task INTEGER NOT NULL REFERENCES tasks, name TEXT NOT NULL, metric TEXT NOT NULL,
    value REAL, tolerance REAL, verdict TEXT NOT NULL, margin REAL, reference TEXT NOT NULL, detail TEXT NOT NULL);
CREATE INDEX scores_of_task ON scores (task);
CREATE TABLE series (
    series INTEGER PRIMARY KEY, task INTEGER NOT NULL REFERENCES tasks, name TEXT NOT NULL, columns TEXT NOT NULL);
CREATE INDEX series_of_task ON series (task);
"""

_QUERIES: dict[str, str] = {
    "runs": "SELECT * FROM runs ORDER BY run",
    "tasks": "SELECT * FROM tasks ORDER BY task",
    # In planned order, whatever the order in which tasks ended: reports must not depend on --jobs.
    "scores": "SELECT * FROM scores ORDER BY task, score",
    "series": "SELECT * FROM series ORDER BY task, series",
    # Not stored: every score with its task, and tasks without scores once, for use elsewhere.
    "results": (
        "SELECT tasks.task, kind, solver, scenario, label, parameters, seed, state, outcome, reason, status,"
        " iterations, visits, wall_s, peak_memory_mb, score, name, metric, value, tolerance, verdict, margin,"
        " reference, detail"
        " FROM tasks LEFT JOIN scores ON scores.task = tasks.task ORDER BY tasks.task, score"
    ),
}
_JSON_COLUMNS = ("environment", "settings", "parameters", "tags", "detail", "columns")
# SQLite keeps NaN as NULL, and a column of NULL alone would come back as objects.
_FLOAT_COLUMNS = ("value", "tolerance", "margin", "wall_s", "peak_memory_mb")
_INTEGER_COLUMNS = ("iterations", "visits", "score")


class StoreError(Exception):
    """The results folder cannot be used; the text says why and what to do. Nothing in it was changed."""


class IncomparableResults(StoreError):
    """The folder holds results of other settings, which must not be mixed with new ones."""


@dataclass(frozen=True)
class PlannedTask:
    """A task with what its row says of it before it ran."""

    task: Task
    settings: Mapping[str, object]
    """All settings of the solver, JSON-able; for a solver from a file also the hash of that file."""
    label: str
    """Scenario with its parameters, as shown: "three-ball-chain(va=0.5)"."""
    tags: frozenset[str] = frozenset()
    """The scenario's tags: a task that crashes counts under them too."""
    number: int = -1
    """Row of the task; -1 until it is stored."""


@dataclass(frozen=True)
class Ending:
    """How a task ended, and what it measured."""

    outcome: Outcome
    reason: str = ""
    """Why, for all outcomes but MEASURED: the exception's line, the signal's name, the limit."""
    wall_s: float = math.nan
    """Time in the child process [s]."""
    peak_memory_mb: float = math.nan
    """Largest resident memory of the child process during the task [MiB]; NaN where it died."""
    measurement: Measurement | None = None


class Store:
    """One results folder. A context manager; `create` and `open` make it."""

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: IO[str] | None) -> None:
        self.path = path
        """The SQLite file."""
        self._connection = connection
        self._lock = lock

    @classmethod
    def create_or_open(cls, folder: str | os.PathLike[str], fingerprint: Mapping[str, object]) -> Store:
        """Open a folder's store for a run, or make an empty one.

        Args:
            folder: results folder; made where it is missing.
            fingerprint: all that makes results incomparable where it differs, JSON-able.

        Raises:
            IncomparableResults: the store's fingerprint is another one; the text lists what differs.
            StoreError: the folder is not writable or full, another run writes to it, or the file is not a sound store.
        """
        path = Path(folder) / FILE_NAME
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(f"cannot make the results folder {path.parent}: {error.strerror}") from error
        lock = _take_lock(path.parent / LOCK_NAME)
        with ExitStack() as undo:
            undo.callback(lock.close)
            with _explained(path):
                connection = _connect(path)
                undo.callback(connection.close)
                if _is_empty(connection):
                    _create_schema(connection, fingerprint)
                # Before anything is written: a file that is not ours must stay as it is.
                _check_schema(path, connection)
                _check_fingerprint(path, connection, fingerprint)
                _use_write_ahead_log(connection)
            undo.pop_all()
        return cls(path, connection, lock)

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Store:
        """Open a folder's store for reading; works while a run writes to it.

        Raises:
            StoreError: there is no store, or it is not a sound one.
        """
        path = Path(folder) / FILE_NAME
        if not path.is_file():
            raise StoreError(
                f"no results in {path.parent}: {FILE_NAME} is missing; "
                f"measure first: impactbench run --out {path.parent}"
            )
        with ExitStack() as undo:
            with _explained(path):
                connection = _connect(path, mode="ro")
                undo.callback(connection.close)
                _check_schema(path, connection)
            undo.pop_all()
        return cls(path, connection, None)

    def begin_run(
        self, *, version: str, environment: Mapping[str, object], settings: Mapping[str, object], command: str
    ) -> int:
        """Store the start of a run and return its number."""
        with self._transaction() as connection:
            row = connection.execute(
                "INSERT INTO runs (started, version, environment, settings, command) VALUES (?, ?, ?, ?, ?)",
                (_now(), version, _to_json(environment), _to_json(settings), command),
            )
            return int(row.lastrowid or 0)

    def finish_run(self, run: int) -> None:
        """Store the end of a run."""
        with self._transaction() as connection:
            connection.execute("UPDATE runs SET finished = ? WHERE run = ?", (_now(), run))

    def plan(self, tasks: Iterable[PlannedTask], *, run: int) -> list[int]:
        """Store tasks as planned; those that are known already stay as they are.

        Returns:
            The row of each task, in their order.

        Raises:
            IncomparableResults: a task is known with other settings of its solver; nothing was planned.
        """
        with self._transaction() as connection:
            return [self._plan_one(connection, planned, run) for planned in tasks]

    def _plan_one(self, connection: sqlite3.Connection, planned: PlannedTask, run: int) -> int:
        """Find or insert one task; returns its row."""
        identity = _identity(planned.task)
        settings = _to_json(planned.settings)
        known = connection.execute(
            "SELECT task, settings FROM tasks WHERE kind = ? AND solver = ? AND scenario = ? AND parameters = ?"
            " AND seed = ?",
            identity,
        ).fetchone()
        if known is None:
            row = connection.execute(
                "INSERT INTO tasks (kind, solver, scenario, parameters, seed, run, settings, label, tags, state)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, 'planned')",
                (*identity, run, settings, planned.label, _to_json(sorted(planned.tags))),
            )
            return int(row.lastrowid or 0)
        if known[1] != settings:
            of = f"version of the solver {planned.task.solver}"
            raise IncomparableResults(_differences(self.path, json.loads(known[1]), planned.settings, of=of))
        return int(known[0])

    def pending(self) -> list[PlannedTask]:
        """All tasks that are planned and not done, in planned order."""
        with _explained(self.path):
            rows = self._connection.execute(
                "SELECT task, kind, solver, settings, scenario, parameters, label, tags, seed FROM tasks"
                " WHERE state = 'planned' ORDER BY task"
            ).fetchall()
        return [
            PlannedTask(
                Task(Kind(kind), solver, scenario, json.loads(parameters), seed),
                json.loads(settings), label, frozenset(json.loads(tags)), number,
            )
            for number, kind, solver, settings, scenario, parameters, label, tags, seed in rows
        ]  # fmt: skip

    def plan_again(self, numbers: Iterable[int], outcomes: Iterable[Outcome]) -> None:
        """Make tasks planned that ended so, without an answer; what others measured stays as it is.

        Args:
            numbers: rows of tasks.
            outcomes: those of tasks that measured nothing.
        """
        ended = [outcome.value for outcome in outcomes if outcome is not Outcome.MEASURED]
        places = ", ".join("?" * len(ended))
        with self._transaction() as connection:
            connection.executemany(
                "UPDATE tasks SET state = 'planned', outcome = NULL, reason = NULL, wall_s = NULL,"
                f" peak_memory_mb = NULL WHERE task = ? AND outcome IN ({places})",
                [(number, *ended) for number in numbers],
            )

    def record(self, number: int, ending: Ending, *, run: int) -> None:
        """Store how a task ended and all that it measured, in one transaction.

        Args:
            number: the task's row, from `pending`.
            ending: how it ended.
            run: the run that measured it.

        Raises:
            StoreError: no such task is planned, or the disk is full; the store is as it was before.
        """
        measured = ending.measurement
        work = (measured.status, measured.iterations, measured.visits) if measured else (None, None, None)
        with self._transaction() as connection:
            changed = connection.execute(
                "UPDATE tasks SET state = 'done', run = ?, outcome = ?, reason = ?, wall_s = ?, peak_memory_mb = ?,"
                " status = ?, iterations = ?, visits = ? WHERE task = ? AND state = 'planned'",
                (
                    run, ending.outcome.value, ending.reason, ending.wall_s, ending.peak_memory_mb,
                    *work, number,
                ),
            ).rowcount  # fmt: skip
            if changed != 1:
                raise StoreError(f"task {number} is not planned in {self.path}: it is done already, or unknown")
            if measured:
                _insert_measurement(connection, number, measured)

    def frame(self, name: str) -> pd.DataFrame:
        """Return one table; JSON columns come back as Python values, missing numbers as NaN or NA.

        Args:
            name: "runs", "tasks", "scores", "series", or "results" (every score beside its task).
        """
        import pandas as pd

        with _explained(self.path):
            frame = pd.read_sql_query(_QUERIES[name], self._connection)
        for column in _JSON_COLUMNS:
            if column in frame:
                frame[column] = pd.Series(
                    [json.loads(text) if isinstance(text, str) else {} for text in frame[column]], dtype=object
                )
        for columns, dtype in ((_FLOAT_COLUMNS, np.float64), (_INTEGER_COLUMNS, "Int64")):
            for column in columns:
                if column in frame:
                    frame[column] = frame[column].astype(dtype)
        return frame

    def close(self) -> None:
        """Close the file; after a run it is one plain file that can be read from a read-only folder too."""
        if self._lock is not None:
            # Where a reader holds it or the disk is full, the log stays beside the file, and nothing is lost.
            with suppress(sqlite3.Error):
                self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """All or nothing."""
        with _explained(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                # SQLite has rolled back by itself after a full disk.
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise


def set_aside(folder: str | os.PathLike[str]) -> Path | None:
    """Rename a folder's store to the first free results-N.sqlite, for a fresh start that destroys nothing.

    Returns:
        The new path, or None where there was no store.

    Raises:
        StoreError: a run is writing to it, or it cannot be renamed.
    """
    path = Path(folder) / FILE_NAME
    if not path.exists():
        return None
    with _take_lock(path.parent / LOCK_NAME):
        number = 1
        while (aside := path.with_name(f"results-{number}.sqlite")).exists():
            number += 1
        try:
            # The log of a killed run belongs to the file and moves first: without it rows would be missing.
            for suffix in ("-wal", "-shm", ""):
                part = path.with_name(path.name + suffix)
                if part.exists():
                    part.rename(aside.with_name(aside.name + suffix))
        except OSError as error:
            raise StoreError(f"cannot set {path} aside: {error.strerror}") from error
    return aside


def _insert_measurement(connection: sqlite3.Connection, number: int, measured: Measurement) -> None:
    """Insert the scores and series of one task."""
    connection.executemany(
        "INSERT INTO scores (score, task, name, metric, value, tolerance, verdict, margin, reference, detail)"
        " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        [
            (
                number * ROWS_PER_TASK + row, number, score.name, score.metric,
                float(score.value), float(score.tolerance), score.verdict.value, float(score.margin),
                score.reference, _to_json(score.detail),
            )
            for row, score in enumerate(measured.scores)
        ],
    )  # fmt: skip
    connection.executemany(
        "INSERT INTO series (series, task, name, columns) VALUES (?, ?, ?, ?)",
        [
            (number * ROWS_PER_TASK + row, number, series.name, _to_json(series.columns))
            for row, series in enumerate(measured.series)
        ],
    )


def _take_lock(path: Path) -> IO[str]:
    """Hold the folder for one writing run; the system lets go when the process ends, however it ends."""
    try:
        lock = path.open("a")
    except OSError as error:
        raise StoreError(
            f"cannot write to the results folder {path.parent}: {error.strerror}; choose another with --out"
        ) from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise StoreError(f"another run is writing to {path.parent}: wait for it, or choose another --out") from None
    except OSError:
        # Some network file systems have no locks; SQLite's own still keep every transaction whole.
        pass
    return lock


def _connect(path: Path, mode: Literal["rwc", "ro"] = "rwc") -> sqlite3.Connection:
    """Open the file; transactions are begun by hand."""
    return sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None
    )


def _use_write_ahead_log(connection: sqlite3.Connection) -> None:
    """Use the write-ahead log where the file system has what it needs; SQLite keeps its old way elsewhere.

    With synchronous=NORMAL a killed process loses nothing. A power cut may lose the last rows, never the file; they are
    planned still and are measured again.
    """
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")


def _is_empty(connection: sqlite3.Connection) -> bool:
    return connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone() is None


def _create_schema(connection: sqlite3.Connection, fingerprint: Mapping[str, object]) -> None:
    """Make the tables, all or none."""
    connection.execute("BEGIN IMMEDIATE")
    for statement in SCHEMA.split(";"):
        connection.execute(statement)
    connection.execute("INSERT INTO meta VALUES ('fingerprint', ?)", (_to_json(fingerprint),))
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
    connection.execute("COMMIT")


def _check_schema(path: Path, connection: sqlite3.Connection) -> None:
    """Check that the file is a store, of this version, and sound."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise StoreError(f"{path} is an SQLite file, but no impactbench store; choose another --out")
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version != SCHEMA_VERSION:
        age = "newer" if version > SCHEMA_VERSION else "older"
        raise StoreError(
            f"{path} was written by a{'n' if age == 'older' else ''} {age} impactbench (store version {version}, here "
            f"{SCHEMA_VERSION}): use that version, another --out, or --fresh, which sets the file aside"
        )
    verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if verdict != "ok":
        raise StoreError(_damaged(path, verdict))


def _check_fingerprint(path: Path, connection: sqlite3.Connection, fingerprint: Mapping[str, object]) -> None:
    """Refuse to mix results that cannot be compared."""
    stored = json.loads(connection.execute("SELECT value FROM meta WHERE key = 'fingerprint'").fetchone()[0])
    if stored != json.loads(_to_json(fingerprint)):
        raise IncomparableResults(_differences(path, stored, fingerprint, of="run"))


def _differences(path: Path, stored: Mapping[str, object], now: Mapping[str, object], *, of: str) -> str:
    """Say what differs between two sets of settings, and what to do."""
    lines = [
        f"  {key}: stored {stored.get(key, 'nothing')}, now {now.get(key, 'nothing')}"
        for key in sorted({*stored, *now})
        if stored.get(key) != now.get(key)
    ]
    return "\n".join([
        f"{path} holds results of another {of}, which cannot be compared:",
        *lines,
        "use the same settings to go on, --out FOLDER for a second set of results, or --fresh to set these aside",
    ])  # fmt: skip


def _damaged(path: Path, symptom: str) -> str:
    return (
        f"{path} is damaged or not a results file ({' '.join(symptom.split())}). It was left as it is. "
        "--fresh sets it aside and starts anew; a copy may be readable with `sqlite3 … .recover`"
    )


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into ones that say what to do."""
    try:
        yield
    except sqlite3.OperationalError as error:
        text = str(error)
        if "full" in text or "disk I/O" in text:
            raise StoreError(
                f"cannot write to {path}: {text}. What was measured before is kept. "
                "Free some space and run the same command again: it goes on where it stopped"
            ) from error
        if "readonly" in text or "unable to open" in text:
            raise StoreError(f"cannot write to {path}: {text}; choose another folder with --out") from error
        if "locked" in text:
            raise StoreError(f"{path} is in use by another program: {text}") from error
        raise StoreError(_damaged(path, text)) from error
    except sqlite3.DatabaseError as error:
        raise StoreError(_damaged(path, str(error))) from error


def _identity(task: Task) -> tuple[str, str, str, str, int]:
    return task.kind.value, task.solver, task.scenario, _to_json(task.parameters), task.seed


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _to_json(value: Mapping[str, object] | Sequence[object]) -> str:
    """Encode with sorted keys; NaN and Infinity are kept (Python reads them back)."""
    return json.dumps(value, sort_keys=True, ensure_ascii=False, default=_plain)


def _plain(value: Any) -> object:
    """Turn what JSON does not know into what it does."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    raise TypeError(f"{type(value).__name__} cannot be stored: {value!r}")
