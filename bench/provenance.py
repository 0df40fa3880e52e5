"""Where figures come from: the command, commit, machine and versions that every published file carries."""

from __future__ import annotations

import datetime
import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

DISTRIBUTION = "latticebench"


def describe(command: Sequence[str], seeds: Sequence[int] = (), **more: Any) -> dict[str, Any]:
    """Describe a run: a flat dictionary of texts, numbers and lists.

    Args:
        command: the arguments after `latticebench`.
        seeds: what the random draws were seeded with.
        more: further entries.
    """
    return {
        "command": " ".join(["latticebench", *command]),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d"),
        "machine": machine(),
        "versions": versions(),
        "seeds": sorted(set(seeds)),
        **more,
    }


def commit() -> str:
    """Name the commit of the source tree, with "+changes" where files differ from it; "release" outside a repository."""
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


def machine() -> str:
    """Describe the machine without naming it: processor, cores, memory, system."""
    import psutil

    processor = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                processor = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    memory = round(psutil.virtual_memory().total / 2**30)
    return f"{processor}, {os.cpu_count()} cores, {memory} GiB, {platform.system()} {platform.machine()}"


def versions() -> dict[str, str]:
    """Give the versions of Python, of this package, and of the packages that it needs."""
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
            value = ", ".join(str(entry) for entry in value)
        written.append(f"{name}: {value}")
    return written


def command_line() -> list[str]:
    """Give the arguments of this process, without the path of the program."""
    return sys.argv[1:]
