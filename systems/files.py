"""Reading and writing files: only regular ones, of a size that fits, and whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from latticebench.systems.errors import InputError, printable

# MiB up to which a file is read: of data, and of texts such as suites. The environment variable LARGEST raises both.
DATA = 512
TEXT = 16
LARGEST = "LATTICEBENCH_LARGEST_FILE"
KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket"}


def shown(path: Path | str) -> str:
    """Return a path as text that can be printed and encoded: other bytes and signs are written as escapes."""
    return printable(os.fsencode(path).decode("utf-8", "backslashreplace"))


def largest(usual: int) -> int:
    """Return how many bytes of a file are read at most.

    Args:
        usual: MiB, unless the environment says otherwise.

    Raises:
        InputError: the environment says what is no number.
    """
    given = os.environ.get(LARGEST, "")
    if given and not (given.isascii() and given.isdigit() and 0 < len(given) < 10):
        raise InputError(f"{LARGEST}={given}: write a whole number of MiB, such as {DATA}")
    return (int(given) if given else usual) * 2**20


@contextlib.contextmanager
def reading(path: Path, usual: int = TEXT) -> Iterator[BinaryIO]:
    """Open a file to read it, if it is a regular one and not too long.

    Args:
        path: the file.
        usual: MiB, see `largest`.

    Raises:
        InputError: it is missing, cannot be read, is a folder, a pipe or a device, or is too long.
    """
    most = largest(usual)
    try:
        # A pipe without a writer would keep us waiting.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        if os.path.isdir(path):
            raise InputError(f"{shown(path)}: a folder, not a file") from None
        raise InputError(f"{shown(path)}: {_reason(error)}") from None
    about = os.fstat(handle)
    if stat.S_ISDIR(about.st_mode):
        os.close(handle)
        raise InputError(f"{shown(path)}: a folder, not a file")
    with os.fdopen(handle, "rb") as file:
        if not stat.S_ISREG(about.st_mode):
            kind = KINDS.get(stat.S_IFMT(about.st_mode), "something else")
            raise InputError(f"{shown(path)}: {kind}, not a regular file; copy what it gives to a file first")
        if about.st_size > most:
            raise InputError(
                f"{shown(path)}: it has {about.st_size / 2**20:.0f} MiB, at most {most // 2**20} are read; if it is "
                f"meant to be so long, raise that with --largest-file or {LARGEST}"
            )
        try:
            yield file
        except OSError as error:
            raise InputError(f"{shown(path)}: {_reason(error)}") from None


def check_regular(path: Path) -> None:
    """Make sure that there is a regular file that can be read.

    Raises:
        InputError: there is not.
    """
    with reading(path, DATA):
        pass


def read_bytes(path: Path, usual: int = TEXT) -> bytes:
    """Return the content of a regular file; see `reading`."""
    with reading(path, usual) as file:
        # A file of the system's may give more than its size.
        return file.read(largest(usual))


def read_text(path: Path, usual: int = TEXT) -> str:
    """Return the content of a regular text file; see `reading`.

    Raises:
        InputError: it cannot be read, is not UTF-8, or has a NUL; the message names the line.
    """
    content = read_bytes(path, usual)
    try:
        text = content.decode("utf-8")
        wrong = content.find(b"\0")
    except UnicodeDecodeError as error:
        text, wrong = "", error.start
    if wrong >= 0:
        line = content.count(b"\n", 0, wrong) + 1
        raise InputError(f"{shown(path)}: line {line}: not a text file (UTF-8); save it as one")
    return text


def read_json(path: Path, usual: int = TEXT) -> Any:
    """Return the content of a JSON file; see `read_text`.

    Raises:
        InputError: it is none.
    """
    text = read_text(path, usual)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{shown(path)}: not JSON: {one_sentence(error)}") from None


def one_sentence(error: Exception) -> str:
    """Return why a parser gave up, without what only a programmer understands."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if "integer string conversion" in str(error):
        return "an integer has too many digits"
    return str(error).partition("\n")[0]


def _reason(error: Exception) -> str:
    """Return what the system says of a file."""
    if isinstance(error, FileNotFoundError):
        return "no such file"
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


# Writing --------------------------------------------------------------------------------------------------------------


def check_outputs(outputs: Mapping[str, Path | None], inputs: Sequence[Path | None] = ()) -> None:
    """Make sure, before any work, that each output can be written and replaces nothing that it should not.

    Args:
        outputs: the files to be written by the options that name them; None for one that is not asked for.
        inputs: what the same call reads.

    Raises:
        InputError: an output is an input, lies in one that is a folder, or is another output; it is a folder, a pipe
            or a device; or its folder cannot be written to.
    """
    given = {option: path for option, path in outputs.items() if path is not None}
    read = [path for path in inputs if path is not None]
    for number, (option, path) in enumerate(given.items()):
        for other in read:
            if _same(path, other):
                raise InputError(f"{option} {shown(path)}: this file is read by the same command; write to another")
            if _lies_in(path, other):
                raise InputError(
                    f"{option} {shown(path)}: it lies in {shown(other)}, which the same command reads; write elsewhere"
                )
        for before, other in list(given.items())[:number]:
            if _same(path, other):
                raise InputError(f"{option} {shown(path)}: {before} writes to the same file; give each its own")
        _check_place(option, path)


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except (OSError, ValueError):
        # One of the two does not exist yet.
        return os.path.realpath(one) == os.path.realpath(other)


def _lies_in(path: Path, folder: Path) -> bool:
    """Return whether a file lies in a folder of data, or would."""
    return os.path.isdir(folder) and Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def _check_place(option: str, path: Path) -> None:
    """Make sure that a file can be made where a path leads to."""
    try:
        folder = _target(path).parent
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not folder.is_dir():
            raise InputError(f"{option} {shown(path)}: {shown(folder)} is no folder")
        handle, name = tempfile.mkstemp(prefix=".latticebench-", dir=folder)
        os.close(handle)
        os.unlink(name)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{option} {shown(path)}: cannot be written: {_reason(error)}; choose another place") from None


def _target(path: Path) -> Path:
    """Return where a path leads to, through links.

    Raises:
        InputError: there is something that is no regular file.
        OSError: it cannot be looked at.
    """
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    if stat.S_ISREG(mode):
        return target
    what = "a folder" if stat.S_ISDIR(mode) else KINDS.get(stat.S_IFMT(mode), "something else")
    raise InputError(f"{shown(path)}: cannot be written: it is {what}; give the name of a file")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` when the block ends without an error.

    Missing folders are made. The temporary name keeps the ending, by which writers choose the format. A link is kept:
    what it leads to is replaced.

    Raises:
        InputError: there is something else than a regular file, the folder cannot be made or written to, or the disk is
            full; `path` is left as it was.
    """
    temporary = None
    try:
        target = _target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.stem[:40]}-", suffix=target.suffix, dir=target.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        # mkstemp makes files that only their owner may read; the umask decides who may read a result.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(target)
    except OSError as error:
        remedy = "; free some space and try again" if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT) else ""
        # What mkdir says of a file in place of the folder would be read as if the file to be written existed.
        taken = isinstance(error, FileExistsError)
        reason = f"{shown(path.parent)} is no folder" if taken else error.strerror or error
        raise InputError(f"{shown(path)}: cannot be written: {reason}; nothing was changed{remedy}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
