"""Writing a site: whole or not at all, and only over one that this program has written."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from latticebench.bench.provenance import lines
from latticebench.bench.site.folders import Folder, read_folder
from latticebench.bench.site.pages import COPIES, pages, walk
from latticebench.systems.errors import InputError, printable
from latticebench.systems.files import DATA, read_text, reading, shown

MANIFEST = "manifest.txt"
FIRST_LINE = "The files of a site by latticebench publish; it may be written anew while there are no others here."


def build(given: Sequence[Path], out: Path, about: Mapping[str, Any]) -> list[str]:
    """Write the site of folders of published results, and return the paths of its files.

    Args:
        given: the folders.
        out: the folder of the site; it is new, empty, or one of this program's.
        about: where the site comes from, see `bench.provenance`.

    Raises:
        InputError: a folder is none of published results, or is damaged; or the site cannot be written there.
    """
    check_place(out, given)
    folders = read(given)
    with _fresh(out) as site:
        written = {path: text.encode(errors="backslashreplace") for path, text in pages(folders, about)}
        for path, content in written.items():
            (site / path).parent.mkdir(parents=True, exist_ok=True)
            (site / path).write_bytes(content)
        copied = [_copy(folder, name, site) for folder in walk(folders) for name in folder.files]
        files = sorted([*written, *copied])
        told = [FIRST_LINE, *(f"# {line}" for line in lines(about)), *files]
        (site / MANIFEST).write_text("\n".join(told) + "\n", encoding="utf-8", errors="backslashreplace")
    return files


def read(given: Sequence[Path]) -> tuple[Folder, ...]:
    """Read folders of published results.

    Raises:
        InputError: one is none, two have the same name, or one has the name of the folder of copies.
    """
    names = [printable(Path(os.path.realpath(one)).name) for one in given]
    for name, path in zip(names, given, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{shown(path)}: two folders are called {name!r}; rename one")
        if name in ("", COPIES):
            raise InputError(f"{shown(path)}: a folder of results cannot be called {name!r} in a site; rename it")
    return tuple(read_folder(path, (name,)) for name, path in zip(names, given, strict=True))


def check_place(out: Path, given: Sequence[Path]) -> None:
    """Make sure that a site can be written to a folder.

    Raises:
        InputError: it holds or lies in what is published, or has files that are not a site's.
    """
    place = Path(os.path.realpath(out))
    for one in given:
        source = Path(os.path.realpath(one))
        if source == place or source in place.parents or place in source.parents:
            raise InputError(f"--out {shown(out)}: it lies in {shown(one)}, or that in it; write to another folder")
    if not os.path.lexists(place):
        return
    if not place.is_dir():
        raise InputError(f"--out {shown(out)}: a file, not a folder; give another name")
    there = {path.relative_to(place).as_posix() for path in place.rglob("*") if not path.is_dir()}
    if not there and not any(place.iterdir()):
        return
    if MANIFEST not in there or not read_text(place / MANIFEST).startswith(FIRST_LINE):
        raise InputError(f"--out {shown(out)}: this folder is not a site of this command; give a new one")
    others = there - {MANIFEST, *read_text(place / MANIFEST).splitlines()}
    if others:
        raise InputError(
            f"--out {shown(out)}: {printable(min(others))} is not of the site; move it away, or give a new folder"
        )


@contextlib.contextmanager
def _fresh(out: Path) -> Iterator[Path]:
    """Yield a folder beside `out`, which takes its place when the block ends without an error.

    Raises:
        InputError: it cannot be made or written to; `out` is left as it was.
    """
    target = Path(os.path.realpath(out))
    made: list[Path] = []
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        made.append(Path(tempfile.mkdtemp(prefix=".latticebench-", dir=target.parent)))
        new, old = made[0] / "new", made[0] / "old"
        new.mkdir()
        yield new
        if os.path.lexists(target):
            target.replace(old)
        try:
            new.replace(target)
        except OSError:
            if old.exists():
                old.replace(target)
            raise
    except OSError as error:
        raise InputError(f"--out {shown(out)}: cannot be written: {error.strerror or error}") from error
    finally:
        for folder in made:
            shutil.rmtree(folder, ignore_errors=True)


def _copy(folder: Folder, name: str, site: Path) -> str:
    """Copy a file of a folder into the site, and return its path there."""
    path = f"{COPIES}/{folder.name}/{name}"
    (site / path).parent.mkdir(parents=True, exist_ok=True)
    with reading(folder.path / name, DATA) as source, (site / path).open("wb") as target:
        shutil.copyfileobj(source, target)
    return path
