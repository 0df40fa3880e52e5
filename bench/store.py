"""The store of results: one SQLite file in the folder of a run.

    results  one row per finished case: key, identity, kind, case, status, reason, seed, origin, content, history
    origins  what made results: commit, date, machine and versions, each once
    suite    the keys of the suite that was run last, in their order
    about    what else was written down of that run: command, settings
    leases   which run is on which case, see `bench.leases`
    runs     how far each run is that is on this store now, see `bench.presence`

Each result is committed at once, in a transaction of its own, so that a killed run loses nothing that it had
reported, and two runs at once harm nothing. The history of a fit, which is most of a result, is read only where it is
asked for.
"""

from __future__ import annotations

import json
import os
import sqlite3
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latticebench.bench.case import STATUSES, Case
from latticebench.systems.errors import InputError
from latticebench.systems.files import shown

VERSION = 5
FILE = "results.sqlite"
# In the head of the file, by which a store is known: "LtBn".
APPLICATION = 0x4C74426E
# Seconds to wait for another run that is writing.
PATIENCE = 15.0
# A file with its journal, while it is being made or written.
OWN_FILES = tuple(FILE + ending for ending in ("", "-wal", "-shm", "-journal"))
TABLES = """
CREATE TABLE IF NOT EXISTS origins (number INTEGER PRIMARY KEY, origin TEXT NOT NULL UNIQUE);
CREATE TABLE IF NOT EXISTS results (
    key TEXT PRIMARY KEY, identity TEXT NOT NULL, kind TEXT NOT NULL, "case" TEXT NOT NULL, status TEXT NOT NULL,
    reason TEXT NOT NULL, seed INTEGER, origin INTEGER NOT NULL REFERENCES origins, content TEXT NOT NULL, history TEXT
);
CREATE INDEX IF NOT EXISTS by_identity ON results (identity, key);
CREATE INDEX IF NOT EXISTS by_key ON results (key, kind, status, seed, origin);
CREATE TABLE IF NOT EXISTS suite (place INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE);
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS leases (key TEXT PRIMARY KEY, owner TEXT NOT NULL, until REAL NOT NULL);
CREATE TABLE IF NOT EXISTS runs (owner TEXT PRIMARY KEY, until REAL NOT NULL, content TEXT NOT NULL);
"""
# What reading or writing a file of SQLite raises; a text in it that is not UTF-8 is no error of its own.
FAILURES = (sqlite3.Error, UnicodeError)
CHOOSE = "choose another place with --results"
# A fit of fewer seconds is had again sooner than a disk has written thousands of them one by one.
QUICK = 0.1


@dataclass(frozen=True)
class Shard:
    """Every `step`-th case of a suite, beginning with the `first`-th (from 1)."""

    first: int = 1
    step: int = 1

    def __post_init__(self) -> None:
        """Check that there is such a part."""
        if not 1 <= self.first <= self.step:
            raise InputError(f"shard {self.first}/{self.step}: write K/N with K from 1 to N, such as 1/10")


WHOLE = Shard()


@dataclass(frozen=True, eq=False)
class Store:
    """An open store; `create` and `open_store` make it, and it closes itself when it is no longer used."""

    path: Path
    connection: sqlite3.Connection

    def __post_init__(self) -> None:
        """See to it that the file is closed."""
        weakref.finalize(self, self.connection.close)

    def put(self, key: str, case: Case, result: Mapping[str, Any], made: Mapping[str, Any]) -> None:
        """Keep a result at once, in place of an earlier one; the order of its terms is that of the library.

        Whatever ends the process, the result is kept; that of a quick fit may be lost when the machine fails.

        Args:
            key: see `bench.source.keys`.
            case: what was run.
            result: `status`, `reason` and the names of `case.blank()`.
            made: see `bench.provenance.origin`.

        Raises:
            InputError: it cannot be written (a full disk); earlier results stay as they are.
            ValueError: it is not a result of such a case.
        """
        content = {**result}
        status, reason = content.pop("status"), content.pop("reason")
        if status not in STATUSES or content.keys() != case.blank().keys():
            raise ValueError(f"not a result of {case.title}: status {status!r}, with {sorted(content)}")
        history = content.pop("history", None)
        seed = getattr(case, "seed", None)
        texts = [None if value is None else json.dumps(value, allow_nan=False) for value in (made, content, history)]
        seconds = content.get("seconds")
        with self.writing(durable=not isinstance(seconds, float) or seconds >= QUICK) as cursor:
            cursor.execute("INSERT OR IGNORE INTO origins (origin) VALUES (?)", texts[:1])
            cursor.execute(
                "INSERT OR REPLACE INTO results SELECT ?, ?, ?, ?, ?, ?, ?, number, ?, ? FROM origins WHERE origin = ?",
                (key, case.identity, case.kind, case.model_dump_json(), status, reason, seed, *texts[1:], texts[0]),
            )
            cursor.execute("DELETE FROM leases WHERE key = ?", (key,))

    def plan(self, keys: Mapping[str, str], about: Mapping[str, Any]) -> None:
        """Record which suite is run.

        Args:
            keys: of the cases, by their identities.
            about: the command and what else is worth knowing.
        """
        rows = [(place, key, identity) for place, (identity, key) in enumerate(keys.items())]
        with self.writing() as cursor:
            # In this connection it hides the table of the file: a run goes by its own plan, whatever another run on
            # the same store plans meanwhile.
            cursor.execute(
                "CREATE TEMP TABLE IF NOT EXISTS suite (place INTEGER PRIMARY KEY, key TEXT UNIQUE, identity TEXT)"
            )
            cursor.execute("DELETE FROM temp.suite")
            cursor.executemany("INSERT INTO temp.suite VALUES (?, ?, ?)", rows)
            cursor.execute("DELETE FROM main.suite")
            cursor.execute("INSERT INTO main.suite SELECT place, key FROM temp.suite")
            cursor.execute("DELETE FROM about")
            cursor.executemany(
                "INSERT INTO about VALUES (?, ?)", [(name, json.dumps(value)) for name, value in about.items()]
            )

    def fill(self, keys: Iterable[str], about: Mapping[str, Any], rows: Iterable[Sequence[Any]]) -> None:
        """Take results over as other stores have them; this one must be new.

        Args:
            keys: of the cases of the suite, in its order.
            about: the command and what else is worth knowing.
            rows: of `results`, with the text of the origin in place of its number.
        """
        with self.writing() as cursor:
            cursor.executemany("INSERT INTO main.suite VALUES (?, ?)", enumerate(keys))
            cursor.executemany(
                "INSERT INTO about VALUES (?, ?)", [(name, json.dumps(value)) for name, value in about.items()]
            )
            for row in rows:
                cursor.execute("INSERT OR IGNORE INTO origins (origin) VALUES (?)", (row[7],))
                cursor.execute(
                    "INSERT INTO results SELECT ?, ?, ?, ?, ?, ?, ?, number, ?, ? FROM origins WHERE origin = ?",
                    (*row[:7], *row[8:], row[7]),
                )

    def forget_replaced(self) -> None:
        """Remove what another source made of the planned cases, where there is a result of the planned one.

        So a run that is stopped, or is of a shard alone, takes nothing away that it has not made anew.
        """
        with self.writing() as cursor:
            cursor.execute(
                "DELETE FROM results WHERE key IN (SELECT old.key FROM temp.suite AS planned "
                "JOIN results AS fresh ON fresh.key = planned.key "
                "JOIN results AS old ON old.identity = planned.identity WHERE old.key <> planned.key)"
            )

    def relabel(self, cases: Mapping[str, Case]) -> None:
        """Record the labels and limits that cases have in this suite; the keys are those of their results."""
        with self.writing() as cursor:
            rows = [(case.model_dump_json(), key) for key, case in cases.items()]
            cursor.executemany('UPDATE results SET "case" = ? WHERE key = ?', rows)

    def finished(self, key: str | None = None) -> dict[str, tuple[str, str]]:
        """Return the status and the case, as JSON, of each finished case of the suite that was run last, by its key.

        Args:
            key: of one case, if not of all.
        """
        only = ("", ()) if key is None else (" WHERE key = ?", (key,))
        rows = self.read(f'SELECT key, status, "case" FROM results JOIN suite USING (key){only[0]}', only[1])
        return {found: (status, case) for found, status, case in rows}

    def statuses(self, shard: Shard = WHOLE) -> dict[str, int]:
        """Return how many finished cases of the suite that was run last ended with each status."""
        query = (
            "SELECT status, COUNT(*) FROM suite JOIN results USING (key) WHERE place % ? = ? "
            "GROUP BY status ORDER BY status"
        )
        return dict(self.read(query, (shard.step, shard.first - 1)))

    def others(self) -> int:
        """Return how many results there are of cases that the suite that was run last does not have."""
        ((count,),) = self.read("SELECT COUNT(*) FROM results WHERE key NOT IN (SELECT key FROM suite)")
        return int(count)

    def kinds(self) -> list[str]:
        """Return the kinds of the finished cases of the suite that was run last."""
        return [kind for (kind,) in self.read("SELECT DISTINCT kind FROM suite JOIN results USING (key) ORDER BY kind")]

    def results(self, shard: Shard = WHOLE, kind: str = "%", *, history: bool = False) -> Results:
        """Return the finished results of the suite that was run last, in its order; each reading reads the store anew.

        Args:
            shard: the part of the suite.
            kind: of the cases; all if not given.
            history: read the histories of fits too; they are None otherwise.
        """
        return Results(self, shard, kind, history)

    def about(self) -> dict[str, Any]:
        """Return what was written down of the suite that was run last; empty where none was."""
        with self.sound():
            return {name: json.loads(value) for name, value in self.read("SELECT name, value FROM about ORDER BY name")}

    def origins(self) -> list[dict[str, Any]]:
        """Return the commits, dates, machines and versions that made the results of the suite that was run last."""
        used = "SELECT DISTINCT origin FROM suite JOIN results USING (key)"
        with self.sound():
            return [json.loads(text) for (text,) in self.read(f"SELECT origin FROM origins WHERE number IN ({used})")]

    @contextmanager
    def sound(self) -> Iterator[None]:
        """Turn what goes wrong with content of another form than that of results into one line of text.

        Raises:
            InputError: the content is damaged.
        """
        try:
            yield
        except InputError:
            raise
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise _damaged(self.path, f"a result has another form ({type(error).__name__}: {error})") from error

    def seeds(self) -> list[int]:
        """Return the seeds of the finished cases of the suite that was run last."""
        rows = self.read("SELECT DISTINCT seed FROM suite JOIN results USING (key) ORDER BY seed")
        return [number for (number,) in rows if number is not None]

    @contextmanager
    def writing(self, *, durable: bool = True) -> Iterator[sqlite3.Cursor]:
        """Write all that the block does, or nothing; what is written inside belongs to it.

        Args:
            durable: wait until it is on the disk; what is not may be lost when the machine, not when the run, fails.

        Raises:
            InputError: it cannot be written, or is damaged.
        """
        try:
            if self.connection.in_transaction:
                yield self.connection.cursor()
                return
            if not durable:
                self.connection.execute("PRAGMA synchronous = NORMAL")
            with self.connection:
                yield self.connection.execute("BEGIN IMMEDIATE")
            if not durable:
                self.connection.execute("PRAGMA synchronous = FULL")
        except FAILURES as error:
            raise _unwritable(self.path, error) from None

    def read(self, query: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        """Ask the file.

        Raises:
            InputError: it is damaged.
        """
        try:
            yield from self.connection.execute(query, values)
        except FAILURES as error:
            raise _unreadable(self.path, error) from None


@dataclass(frozen=True)
class Results:
    """Results in the order of their suite, read from the store one after the other each time they are gone through.

    Each is a dictionary: `case`, `identity`, `status`, `reason`, `made`, and the names of the case's `blank`.
    """

    store: Store
    shard: Shard
    kind: str
    history: bool

    def __len__(self) -> int:
        """Count them."""
        return int(next(self._rows("COUNT(*)"))[0])

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Read them.

        Raises:
            InputError: the store is damaged.
        """
        with self.store.sound():
            rows = self.store.read("SELECT number, origin FROM origins")
            origins = {number: json.loads(text) for number, text in rows}
        history = "history" if self.history else "NULL"
        columns = f'key, results.identity, "case", status, reason, origin, content, {history}'
        for key, identity, case, status, reason, origin, content, past in self._rows(columns):
            try:
                found = {"case": json.loads(case), "identity": identity, "status": status, "reason": reason}
                found.update(json.loads(content), made=origins[origin], history=past and json.loads(past))
            except (ValueError, TypeError, KeyError, RecursionError):
                raise _damaged(self.store.path, f"the result {key} is not one") from None
            yield found

    def _rows(self, columns: str) -> Iterator[tuple[Any, ...]]:
        query = (
            f"SELECT {columns} FROM suite JOIN results USING (key) WHERE place % ? = ? AND kind LIKE ? ORDER BY place"
        )
        return self.store.read(query, (self.shard.step, self.shard.first - 1, self.kind))


def create(folder: Path) -> Store:
    """Open a store, or make one in a folder that is empty or does not exist.

    Raises:
        InputError: the folder holds something else, is of another version, or cannot be written.
    """
    if os.path.exists(folder) and not os.path.isdir(folder):
        raise InputError(f"{shown(folder)}: a file, not a folder; {CHOOSE}")
    path = folder / FILE
    try:
        _refuse_json(folder)
        if folder.is_dir() and any(one.name not in OWN_FILES for one in folder.iterdir()) and not path.exists():
            raise InputError(f"{folder}: not a store of results and not empty; {CHOOSE}")
        folder.mkdir(parents=True, exist_ok=True)
        # A folder that a link in place of the file leads to is none that was chosen.
        if os.path.lexists(path) and not _is_file(path):
            raise InputError(f"{shown(path)}: not a store of results, nor a file; {CHOOSE}")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) else None
        raise InputError(f"{shown(folder)}: {reason or error}; {CHOOSE}") from None
    try:
        connection = _connect(path, "rwc", fresh=True)
        try:
            _keep_journal(connection)
            marks = f"PRAGMA application_id = {APPLICATION}; PRAGMA user_version = {VERSION};"
            connection.executescript(f"BEGIN IMMEDIATE; {TABLES} {marks} COMMIT;")
        except FAILURES:
            connection.close()
            raise
    except FAILURES as error:
        raise _unwritable(path, error) from None
    return Store(path, connection)


def open_store(folder: Path) -> Store:
    """Open a store that exists, to read it.

    Raises:
        InputError: there is none, it is damaged, or it is of another version.
    """
    _refuse_json(folder)
    path = folder / FILE
    if not _is_file(path):
        raise InputError(
            f"{shown(folder)}: not a store of results (no {FILE} in it); "
            f"make one with: latticebench run SUITE --results {folder}"
        )
    try:
        return Store(path, _connect(path, "rw"))
    except FAILURES as error:
        # A place that cannot be written has no room for the index of a journal; nor does anybody write there.
        if not isinstance(error, sqlite3.OperationalError) or (folder / OWN_FILES[1]).exists():
            raise _unreadable(path, error) from None
    try:
        return Store(path, _connect(path, "ro&immutable=1"))
    except FAILURES as error:
        raise _unreadable(path, error) from None


def is_store(folder: Path) -> bool:
    """Return whether a folder holds a store, be it one that cannot be read."""
    return _is_file(folder / FILE) or _is_file(folder / "store.json")


def store_in(folder: Path) -> Store | None:
    """Return the store in a folder, to read it; None where there is none, or none yet: another run is making it.

    Raises:
        InputError: it is damaged, or of another version.
    """
    return open_store(folder) if is_store(folder) and not _is_blank(folder / FILE) else None


def _is_blank(path: Path) -> bool:
    """Return whether a file is a database that has nothing in it."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            (tables,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
            (application,) = connection.execute("PRAGMA application_id").fetchone()
    except FAILURES:
        return False
    return not tables and not application


def _is_file(path: Path) -> bool:
    """Return whether there is a regular file, of whatever name."""
    return os.path.isfile(path)


def _connect(path: Path, mode: str, *, fresh: bool = False) -> sqlite3.Connection:
    """Open a file, and make sure that it is a store of this version or, where it may be fresh, has nothing in it."""
    uri = f"{path.resolve().as_uri()}?mode={mode}"
    # The collector of garbage, which may be at work in any thread, closes it.
    connection = sqlite3.connect(uri, uri=True, timeout=PATIENCE, isolation_level=None, check_same_thread=False)
    try:
        # The file may be anybody's: what its schema calls must be harmless.
        connection.execute("PRAGMA trusted_schema = OFF")
        _check(connection, path, fresh)
    except (*FAILURES, InputError):
        connection.close()
        raise
    return connection


def _keep_journal(connection: sqlite3.Connection) -> None:
    """Spare readers and a writer waiting for each other; a rollback journal stands in where the file system cannot."""
    try:
        connection.execute("PRAGMA journal_mode = WAL")
    except sqlite3.OperationalError:
        connection.execute("PRAGMA journal_mode = DELETE")


def _check(connection: sqlite3.Connection, path: Path, fresh: bool) -> None:
    # Another run may be making it: all of this is of one moment.
    connection.execute("BEGIN")
    try:
        names = {name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
        application, version = (
            connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
        )
    finally:
        # A file that is damaged may have ended it.
        if connection.in_transaction:
            connection.execute("ROLLBACK")
    if fresh and not names and not application:
        return
    if application != APPLICATION:
        raise InputError(f"{path}: not a store of results; {CHOOSE}")
    if version != VERSION:
        raise _other_version(path.parent, version)
    if not {"results", "origins", "suite", "about"} <= names:
        raise _damaged(path, "tables are missing")


def _refuse_json(folder: Path) -> None:
    """Refuse a store of JSON files, as there were up to version 2."""
    if _is_file(folder / "store.json"):
        raise _other_version(folder, "2 or older")


def _other_version(folder: Path, version: object) -> InputError:
    return InputError(
        f"{folder}: a store of version {version}, this latticebench reads version {VERSION}; "
        "run the suite again into another folder with --results, or use the latticebench that made it"
    )


def _unwritable(path: Path, error: Exception) -> InputError:
    if not isinstance(error, sqlite3.OperationalError):
        return _damaged(path, str(error))
    return InputError(
        f"{path}: cannot be written: {error}; nothing that was there is lost; is the place full or read-only?"
    )


def _unreadable(path: Path, error: Exception) -> InputError:
    """Tell a place that is full or locked from a store that is damaged: of the former nothing must be deleted."""
    if isinstance(error, sqlite3.OperationalError) and not str(error).startswith("no such"):
        return InputError(f"{path}: cannot be read now: {error}; is the place full, or another run writing to it?")
    return _damaged(path, str(error))


def _damaged(path: Path, what: str) -> InputError:
    return InputError(f"{path}: not a store of results that can be read: {what}; delete it and run the suite again")
