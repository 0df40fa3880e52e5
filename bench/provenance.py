"""Where figures come from: the command, commit, machine and versions that every published file carries."""

from __future__ import annotations

import datetime
import itertools
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from latticebench.systems.errors import printable

DISTRIBUTION = "latticebench"
# Seeds in a row that are named one by one.
MOST_LISTED = 10


def origin(loads: Collection[str] = ()) -> dict[str, Any]:
    """Describe what computes a result: commit, date, machine, kernels of its linear algebra, and versions.

    Args:
        loads: packages that other processes load to compute it.
    """
    date = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d")
    return {
        "commit": commit(), "date": date, "machine": machine(), "kernels": kernels(loads), "versions": versions(),
    }  # fmt: skip


def describe(origins: Sequence[Mapping[str, Any]], run: Mapping[str, Any], seeds: Iterable[int] = ()) -> dict[str, Any]:
    """Describe where results come from: a flat dictionary of texts, numbers and lists.

    Args:
        origins: of the results; where these differ, all are named.
        run: the command and what else was written down when the suite was run last.
        seeds: of the cases; 1 where none has any.
    """
    described: dict[str, Any] = dict(run)
    for name in ("commit", "date", "machine", "kernels"):
        # Results of earlier versions do not say their kernels.
        described[name] = sorted({str(one[name]) for one in origins if name in one})
    packages: dict[str, set[str]] = {}
    for one in origins:
        for package, version in one["versions"].items():
            packages.setdefault(package, set()).add(version)
    described["versions"] = {package: " and ".join(sorted(found)) for package, found in packages.items()}
    described["seeds"] = sorted(seeds) or [1]
    return described


def _ranges(numbers: Sequence[int]) -> list[int | str]:
    """Write more than MOST_LISTED numbers in a row as their range, such as "1-100"."""
    found: list[int | str] = []
    for _, group in itertools.groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        found += run if len(run) <= MOST_LISTED else [f"{run[0]}-{run[-1]}"]
    return found


def commit() -> str:
    """Return the commit of the source tree, with "+changes" where files differ; "release" outside a repository."""
    folder = Path(__file__).resolve().parent
    try:
        # The package may be installed inside somebody else's repository: only a tree that tracks this file counts.
        subprocess.run(
            ["git", "ls-files", "--error-unmatch", Path(__file__).name],
            cwd=folder,
            capture_output=True,
            check=True,
            timeout=10,
        )
        head = subprocess.run(
            ["git", "rev-parse", "--short=12", "HEAD"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        ).stdout.strip()
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no", "--", "*.py", "*.toml"],
            cwd=folder.parent, capture_output=True, text=True, check=True, timeout=10,
        ).stdout.strip()  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "release"
    return head + ("+changes" if changed else "")


def processor() -> str:
    """Return the name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def machine() -> str:
    """Describe the machine without naming it: processor, cores, memory, system."""
    import psutil

    memory = round(psutil.virtual_memory().total / 2**30)
    return f"{processor()}, {os.cpu_count()} cores, {memory} GiB, {platform.system()} {platform.machine()}"


def kernels(loads: Collection[str] = ()) -> str:
    """Describe what decides the last digits: each BLAS library with its kernel, torch's instructions, and the threads.

    Args:
        loads: packages that other processes load; torch is asked in one of its own where it is among them.
    """
    from threadpoolctl import threadpool_info

    if loads:
        # SciPy has a library of its own.
        import scipy.linalg  # noqa: F401
    told = set()
    for one in threadpool_info():
        if one["user_api"] == "blas":
            kernel = one.get("architecture") or "unknown kernel"
            told.add(f"{one['internal_api']} {one['version']} {kernel} {_threads(one['num_threads'])}")
    return ", ".join([*sorted(told), *_torch(loads)])


def _torch(loads: Collection[str]) -> list[str]:
    """Return torch's instructions and threads, where torch is used."""
    if "torch" in sys.modules:
        torch = sys.modules["torch"]
        return [f"torch {torch.backends.cpu.get_cpu_capability()} {_threads(torch.get_num_threads())}"]
    if "torch" not in loads:
        return []
    asked = "import torch; print(torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())"
    try:
        done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True, timeout=60)
        capability, threads = done.stdout.split()
    except (OSError, subprocess.SubprocessError, ValueError):
        return ["torch unknown"]
    return [f"torch {capability} {_threads(int(threads))}"]


def _threads(number: int) -> str:
    return f"{number} thread{'s' if number > 1 else ''}"


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package, and of the packages that it needs."""
    found = {"python": platform.python_version()}
    try:
        needed = [line for line in metadata.requires(DISTRIBUTION) or () if "extra ==" not in line]
    except metadata.PackageNotFoundError:
        return {**found, DISTRIBUTION: "not installed"}
    for name in (DISTRIBUTION, *(re.split(r"[^\w.-]", line)[0] for line in needed)):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            # Some are needed on other systems only.
            continue
    return found


def lines(about: Mapping[str, Any]) -> list[str]:
    """Write a description as lines of text, for the head of a file."""
    written = []
    for name, value in about.items():
        if value in ({}, [], ""):
            continue
        if isinstance(value, Mapping):
            value = "; ".join(f"{key} {entry}" for key, entry in value.items())
        elif isinstance(value, (list, tuple)):
            value = ", ".join(str(entry) for entry in (_ranges(value) if name == "seeds" else value))
        written.append(printable(f"{name}: {value}"))
    return written


def command_line() -> str:
    """Return the command of this process as it would be typed."""
    return printable(shlex.join(["latticebench", *sys.argv[1:]]))
