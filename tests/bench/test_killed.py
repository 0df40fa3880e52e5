"""Killed runs: whatever a run had reported is in the store, whole, and nothing is there twice."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from commandline import Seeds
from latticebench.bench.store import create, open_store

# Puts cases of ever new seeds into a store and reports each, beginning with the seed given.
WRITER = """
import sys
import time
from pathlib import Path
from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase
from latticebench.bench.provenance import origin
from latticebench.bench.source import keys
from latticebench.bench.store import create
from latticebench.bench.worker import attempt

def cases(seeds):
    base = FitCase(system="phi4", sites=5, samples=8, span=1.0, library="lib1", label="a", method="zero")
    return {case.identity: case for case in (base.model_copy(update={"seed": seed}) for seed in seeds)}

first, count = int(sys.argv[2]), int(sys.argv[3])
every = cases(range(first + count))
key_of = keys(every, Folders())
store = create(Path(sys.argv[1]))
store.plan(key_of, {"command": "writing"})
result = {**attempt(next(iter(every.values())), Folders()), "history": {"loss": [0.5] * 2000}}
made = origin()
print("ready", flush=True)
for identity, case in list(every.items())[first:]:
    store.put(key_of[identity], case, result, made)
    print(case.seed, flush=True)
"""


def written_until_killed(folder: Path, first: int, lines: int, pause: float) -> list[int]:
    """Kill a process that writes results after so many and a pause, and return the seeds that it had reported."""
    command = [sys.executable, "-c", WRITER, str(folder), str(first), "2000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        reported = [int(writer.stdout.readline()) for _ in range(lines)]
        time.sleep(pause)
        writer.kill()
        # What it had reported before the signal came.
        reported += [int(line) for line in writer.stdout.read().split("\n") if line]
    return reported


def hold_after_kills(folder: Path, kills: int, seed: int) -> None:
    draw = random.Random(seed)
    reported: list[int] = []
    for _ in range(kills):
        reported += written_until_killed(folder, len(reported), draw.randrange(40), draw.uniform(0, 0.02))
        kept = [result["case"]["seed"] for result in open_store(folder).results(history=True)]
        # One that was being reported may be there, too.
        assert kept[: len(reported)] == reported == list(range(len(reported)))
        assert len(kept) - len(reported) in (0, 1)
        # The next run begins after those reported, and replaces the other.
    store = open_store(folder)
    rows = list(store.read("SELECT key, identity FROM results"))
    assert len({key for key, _ in rows}) == len({identity for _, identity in rows}) == len(rows)
    assert list(store.read("PRAGMA integrity_check")) == [("ok",)]
    assert all(len(result["history"]["loss"]) == 2000 for result in store.results(history=True))


posix = pytest.mark.skipif(os.name != "posix", reason="sends SIGKILL")


@posix
def test_a_writing_run_that_is_killed_a_few_times_loses_nothing_and_has_nothing_twice(
    tmp_path: Path, seeds: Seeds
) -> None:
    hold_after_kills(tmp_path / "store", 2, *seeds(1, 2))


@posix
@pytest.mark.slow
def test_a_writing_run_that_is_killed_fifty_times_loses_nothing_and_has_nothing_twice(
    tmp_path: Path, seeds: Seeds
) -> None:
    hold_after_kills(tmp_path / "store", 50, *seeds(1, 2))


def test_two_stores_that_are_made_in_one_folder_at_once_are_one(tmp_path: Path) -> None:
    folder = tmp_path / "store"
    command = [sys.executable, "-c", WRITER, str(folder), "0", "40"]
    writers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for writer in writers:
        out, _ = writer.communicate(timeout=300)
        assert writer.returncode == 0
        assert len(out.split()) == 41
    assert len(list(open_store(folder).results())) == 40
    assert len(list(create(folder).read("SELECT key FROM results"))) == 40
