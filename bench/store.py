"""The store of results: a folder with one JSON file a finished case.

    DIR/store.json           which version of the store's form this is
    DIR/run.json             the suite that was run last: command, settings, and the keys of its cases in their order
    DIR/cases/KEY.json       one result; KEY is `Case.key`

A file appears whole or not at all (written beside its place, synced, renamed), so that a killed run or two runs at once can lose
nothing and corrupt nothing.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic

from latticebench.bench.case import blank
from latticebench.bench.suite import Case
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text

VERSION = 2
RESULT = blank(Case.model_construct()).keys() | {"made"}


@dataclass(frozen=True)
class Store:
    """A folder of results; `create` and `open_store` make it."""

    folder: Path

    def path(self, key: str) -> Path:
        """Say where the result of a case lies."""
        return self.folder / "cases" / f"{key}.json"

    def has(self, key: str) -> bool:
        """Say whether a case is finished."""
        return self.path(key).is_file()

    def put(self, key: str, result: dict[str, Any]) -> None:
        """Keep a result at once; the order of its terms is that of the library.

        Raises:
            InputError: it cannot be written (a full disk); earlier results stay as they are.
        """
        write_text(self.path(key), json.dumps(result, allow_nan=False) + "\n")

    def get(self, key: str) -> dict[str, Any]:
        """Read a result.

        Raises:
            InputError: the file is not a result of this version.
        """
        path = self.path(key)
        result = _read(path)
        try:
            Case.model_validate(result.get("case"))
        except pydantic.ValidationError:
            result = {}
        missing = RESULT - result.keys()
        if missing:
            raise InputError(f"{path}: not a result that this version writes; delete it and run the suite again")
        return result

    def all(self) -> list[dict[str, Any]]:
        """Read the finished results of the suite that was run last, in its order.

        Raises:
            InputError: a file is not a result.
        """
        return [self.get(key) for key in self.about().get("keys", []) if self.has(key)]

    def paths(self) -> list[Path]:
        """List the files of the results, in the order of their keys."""
        # Files that start with a dot are being written.
        return sorted(path for path in (self.folder / "cases").glob("*.json") if not path.name.startswith("."))

    def put_about(self, about: dict[str, Any]) -> None:
        """Write down which suite is run."""
        write_text(self.folder / "run.json", json.dumps(about, indent=2, sort_keys=True) + "\n")

    def about(self) -> dict[str, Any]:
        """Read which suite was run last; empty where none was."""
        path = self.folder / "run.json"
        return _read(path) if path.is_file() else {}


def create(folder: Path) -> Store:
    """Open a store, or make one in a folder that is empty or does not exist.

    Raises:
        InputError: the folder holds something else, is of another version, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file, not a folder; choose another place with --results")
    if not (folder / "store.json").is_file():
        try:
            # Another run that is just making the store shows as a file with a dot.
            if folder.is_dir() and any(
                not path.name.startswith(".") and path.name != "store.json" for path in folder.iterdir()
            ):
                raise InputError(f"{folder}: not a store of results and not empty; choose another place with --results")
        except OSError as error:
            raise InputError(f"{folder}: {error.strerror or error}; choose another place with --results") from None
        write_text(folder / "store.json", json.dumps({"version": VERSION}) + "\n")
    store = open_store(folder)
    try:
        (folder / "cases").mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror or error}; choose another place with --results") from None
    return store


def open_store(folder: Path) -> Store:
    """Open a store that exists.

    Raises:
        InputError: there is none, or it is of another version.
    """
    path = folder / "store.json"
    if not path.is_file():
        raise InputError(
            f"{folder}: not a store of results (no store.json in it); make one with: latticebench run SUITE --results {folder}"
        )
    version = _read(path).get("version")
    if version != VERSION:
        raise InputError(
            f"{folder}: a store of version {version!r}, this latticebench reads version {VERSION}; "
            "run the suite again into another folder with --results, or use the latticebench that made it"
        )
    return Store(folder)


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise InputError(f"{path}: not JSON: {error}; delete it and run the suite again") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a result; delete it and run the suite again")
    return content
