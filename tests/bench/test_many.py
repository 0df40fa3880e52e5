"""Large stores: resuming and tabling are quick and small, and nothing of them depends on the number of results."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from commandline import succeed
from latticebench.bench.provenance import origin
from latticebench.bench.source import keys
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.bench.worker import attempt
from pace import pace

SUITE = """
title = "many"

[methods.floor]
method = "zero"

[[grid]]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
noise = [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 0.1]
seeds = "1-{seeds}"
"""


def filled(folder: Path, seeds: int) -> None:
    """Make a store with the results of a suite of ten times as many cases: those of its first case, again and again."""
    (folder / "many.toml").write_text(SUITE.format(seeds=seeds))
    suite, store = load(str(folder / "many.toml")), create(folder / "store")
    key_of = keys(suite.by_identity, suite.folders)
    store.plan(key_of, {"command": "latticebench run many.toml"})
    # Written at once, for the disk's sake.
    store.connection.execute("PRAGMA synchronous = OFF")
    result, made = attempt(suite.cases[0], suite.folders), origin()
    for identity, case in suite.by_identity.items():
        store.put(key_of[identity], case, result, made)


# A process that is started counts its parent's memory as its own peak, so that a small one must start what is measured.
STARTER = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[1:])
_, status, usage = os.wait4(process.pid, 0)
found = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss
print(json.dumps(found), file=sys.stderr)
"""


def measured(*arguments: str, cwd: Path) -> tuple[str, float, float]:
    """Run a command; return what it prints, its processor seconds and its peak memory in MiB."""
    command = [sys.executable, "-c", STARTER, sys.executable, "-m", "latticebench", *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=True)
    code, seconds, peak = json.loads(done.stderr.splitlines()[-1])
    assert code == 0
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return done.stdout, seconds, peak / unit


posix = pytest.mark.skipif(os.name != "posix", reason="measures as POSIX systems do")


def test_a_run_of_a_thousand_finished_cases_has_nothing_to_do_and_is_tabled(tmp_path: Path) -> None:
    filled(tmp_path, 120)
    out = succeed("run", "many.toml", "--results", "store", cwd=tmp_path)
    assert "1200 cases (1200 ok); 0 run now, 1200 were there" in out
    assert "seeds: 1-120" in out
    part = succeed("run", "many.toml", "--results", "store", "--shard", "3/40", cwd=tmp_path)
    assert "30 cases (30 ok); 0 run now, 30 were there" in part
    suite = tmp_path / "many.toml"
    suite.write_text(suite.read_text().replace("methods.floor", "methods.ground"))
    assert "0 run now, 1200 were there" in succeed("run", "many.toml", "--results", "store", cwd=tmp_path)
    succeed("table", "store", "--out", "out", cwd=tmp_path)
    rows = [line for line in (tmp_path / "out" / "cases.csv").read_text().splitlines() if not line.startswith("#")]
    assert len(rows) == 1201
    assert all(",ground," in row for row in rows[1:])


@posix
@pytest.mark.slow
def test_a_hundred_thousand_results_are_resumed_and_tabled_in_seconds_and_in_a_gibibyte(tmp_path: Path) -> None:
    filled(tmp_path, 10_000)
    before = pace()
    for limit, arguments in (
        (5.0, ("run", "many.toml", "--results", "store", "--jobs", "1")),
        (10.0, ("table", "store")),
        (20.0, ("table", "store", "--out", "out")),
    ):
        _, seconds, mebibytes = measured(*arguments, cwd=tmp_path)
        after = pace()
        slower, before = max(before, after), after
        print(
            f"{' '.join(arguments)}: {seconds:.1f} s at {slower:.1f} times those of a 2.5 GHz core, {mebibytes:.0f} MiB"
        )
        # Twice the time that an idle core of 2.5 GHz takes.
        assert seconds <= 2 * limit * slower
        assert mebibytes <= 1024
