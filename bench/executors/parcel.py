"""Users' files on their way to workers, by the hashes of their contents: no shared file system is needed.

At the worker they lie below a folder as they lie at the client below its root, so that relative paths lead where they
led. The name of that folder is the hash of all of them: files that have changed lie elsewhere.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latticebench.bench.case import Case, Folders, code_file
from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, read_bytes

# The settings of a case that may be paths.
PATHS = ("method", "system", "file")


@dataclass(frozen=True)
class Parcel:
    """What lies where at the client.

    Attributes:
        folders: the folders of `bench.case.Folders`, each as the parts of its absolute path below the root.
        files: the hashes of files by their paths of the same form.
    """

    folders: tuple[tuple[str, ...] | None, ...]
    files: tuple[tuple[tuple[str, ...], str], ...]

    @property
    def name(self) -> str:
        """A hash of it all."""
        return hashlib.sha256(repr((self.folders, self.files)).encode()).hexdigest()

    @property
    def hashes(self) -> set[str]:
        """The hashes of the files."""
        return {digest for _, digest in self.files}


def pack(cases: Iterable[Case], folders: Folders) -> tuple[Parcel, dict[str, Path]]:
    """Find the files of users that cases need.

    Returns:
        what is to be laid out, and where each content is at the client, by its hash.
    """
    found = {path for case in cases for path in _files(case, folders)}
    digests = {path: hashlib.sha256(read_bytes(path, DATA)).hexdigest() for path in sorted(found)}
    parcel = Parcel(
        tuple(None if one is None else _parts(one) for one in (folders.suite, folders.data, folders.chosen)),
        tuple((_parts(path), digest) for path, digest in digests.items()),
    )
    return parcel, {digest: path for path, digest in digests.items()}


def _files(case: Case, folders: Folders) -> set[Path]:
    roots, found = case.roots, set()
    if (path := code_file(roots.method)) is not None:
        found.add(folders.methods / path)
    if roots.system.endswith((".py", ".toml")):
        found.add(folders.suite / roots.system)
    if roots.recording and os.path.isfile(folders.data / roots.recording):
        found.add(folders.data / roots.recording)
    return found


def _parts(path: Path) -> tuple[str, ...]:
    return Path(os.path.abspath(path)).parts[1:]


def contents(digests: Iterable[str], paths: Mapping[str, Path]) -> dict[str, bytes]:
    """Read the contents that a worker lacks.

    Raises:
        InputError: a file cannot be read, or is not what it was when the run began.
    """
    found = {}
    for digest in digests:
        found[digest] = read_bytes(paths[digest], DATA)
        if hashlib.sha256(found[digest]).hexdigest() != digest:
            raise InputError(f"{paths[digest]}: it has changed since the run began; run the same command again")
    return found


@dataclass(frozen=True)
class Shelf:
    """The worker's side: contents by their hashes in one folder, and what is laid out in others beside it."""

    root: Path

    def lacking(self, parcel: Parcel) -> set[str]:
        """Return the hashes of contents that are not here."""
        return {digest for digest in parcel.hashes if not (self.root / digest).is_file()}

    def receive(self, given: Mapping[str, bytes]) -> None:
        """Keep contents.

        Raises:
            ValueError: one is not what its hash says.
        """
        for digest, content in given.items():
            if hashlib.sha256(content).hexdigest() != digest:
                raise ValueError(f"the content of {digest} was damaged on its way")
            partial = self.root / f"{digest}.part"
            partial.write_bytes(content)
            partial.replace(self.root / digest)

    def lay_out(self, parcel: Parcel) -> tuple[Path, Folders]:
        """Lay a parcel out, unless it is; return the folder, and where relative paths start from.

        Raises:
            OSError: a content is not here, or a file cannot be written.
        """
        place = self.root / f"laid-{parcel.name}"
        if not place.is_dir():
            partial = self.root / f"part-{parcel.name}"
            for parts in parcel.folders:
                if parts is not None:
                    partial.joinpath(*parts).mkdir(parents=True, exist_ok=True)
            for parts, digest in parcel.files:
                path = partial.joinpath(*parts)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes((self.root / digest).read_bytes())
            partial.rename(place)
        suite, data, chosen = (None if one is None else place.joinpath(*one) for one in parcel.folders)
        assert suite is not None
        assert data is not None
        return place, Folders(suite, data, chosen)


def moved(case: Case, place: Path) -> Case:
    """Return a case with its absolute paths below a folder."""
    given = {name: getattr(case, name) for name in PATHS if hasattr(case, name)}
    paths = {name: path for name, path in given.items() if os.path.isabs(path)}
    return case.model_copy(update={name: str(place.joinpath(*Path(path).parts[1:])) for name, path in paths.items()})


def named_as_sent(result: dict[str, Any], place: Path) -> dict[str, Any]:
    """Return a result in which paths are those of the client."""
    text = json.dumps(result)
    named: dict[str, Any] = json.loads(text.replace(json.dumps(str(place))[1:-1], ""))
    return named
