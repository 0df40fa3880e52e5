"""Odd command lines: each works or is refused in one line, soon, and harms no file."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from commandline import SUITE, Seeds, blocks, latticebench, soon
from latticebench.bench.store import FILE

posix = pytest.mark.skipif(os.name != "posix", reason="pipes and devices as POSIX has them")
WORDS = (
    "", "-1", "0", "1", "2", "1e300", "inf", "nan", "x", "[/x]", "t.csv", "t.npz", "pipe.csv", "/dev/null", "/dev/zero",
    "missing.csv", ".", "..", "/", "store", "s.toml", "u[n]", "u[n];u[n]", "1/0", "u[n]**1e9", "sin(", "phi4", "dnls",
    "lib1", "free", "stlsq", "zero", "oracle", "-", "--", "\x1b[31m", "ü", "x" * 300, "a=1", "C=nan", "threshold=-1",
    "=", "1" + "0" * 30, "K/N", "1/1", "2/3", "out.json", "o/p/q.json", "true",
)  # fmt: skip
SIMULATED = ("--set", "--sites", "--samples", "--span", "--noise", "--trajectories", "--initial")
FITTED = ("--system", "--library", "--terms", "--order", "--ends", "--json")
COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "simulate": (
        ("phi4", "--sites", "5", "--samples", "8", "--out", "x.csv"),
        (*SIMULATED, "--uneven", "--missing", "--ends", "--integrator", "--seed", "--out"),
    ),
    "fit": (
        ("t.csv", "--system", "phi4", "--library", "lib1", "--ends", "free", "--method", "zero"),
        (*FITTED, "--method", "--set", "--seed", "--html"),
    ),
    # Not from the system: the search for what an error would need takes long.
    "limit": (("missing.csv", "--system", "phi4", "--library", "lib1"), (*FITTED, *SIMULATED, "--target")),
    "diagnose": (("missing.csv", "--system", "phi4"), (*FITTED, "--effects", "--holdout", "--html")),
    "table": (("store",), ("--out", "--value", "--only", "--json")), "figures": (("store",), ("--out", "--only")),
    "compare": (("store", "store"), ("--factor", "--json")), "schema": ((), ("--out",)), "data": ((), ("--json",)),
    "list": (("systems",), ("--json",)),
    "plot": (("t.csv", "--only", "map", "--out", "x.svg"), ("--out", "--animate", "--only", "--trajectory")),
    "publish": (("tables", "--out", "site"), ("--out",)),
    "run": (("s.toml", "--jobs", "1", "--results", "store"), ("--jobs", "--results", "--shard", "--data", "--json")),
}  # fmt: skip


def odd_command(draw: random.Random) -> list[str]:
    name = draw.choice(sorted(COMMANDS))
    usual, options = COMMANDS[name]
    words = list(usual)
    for _ in range(draw.randrange(4)):
        match draw.randrange(3):
            case 0 if words:
                words[draw.randrange(len(words))] = draw.choice(WORDS)
            case 1:
                words += [draw.choice(options), draw.choice(WORDS)]
            case _:
                words.insert(draw.randrange(len(words) + 1), draw.choice(WORDS))
    # Only what is small is run.
    return [name, "s.toml", *(word for word in words if word != "s.toml")] if name == "run" else [name, *words]


def survive_commands(folder: Path, seeds: range) -> None:
    (folder / "s.toml").write_text(SUITE)
    latticebench("run", "s.toml", "--jobs", "1", "--results", "store", cwd=folder)
    latticebench("table", "store", "--out", "tables", cwd=folder)
    for name in ("t.csv", "t.npz"):
        latticebench("simulate", "phi4", "--sites", "5", "--samples", "12", "--out", name, cwd=folder)
    os.mkfifo(folder / "pipe.csv")
    before = {name: (folder / name).read_bytes() for name in ("s.toml", "t.csv", "t.npz")}
    for seed in seeds:
        command = odd_command(random.Random(seed))
        code, _, err = soon(*command, cwd=folder)
        assert code in (0, 1, 2), command
        assert code != 2 or (err.startswith("error: ") and err.count("\n") == 1), (command, err)
        changed = [name for name, content in before.items() if (folder / name).read_bytes() != content]
        # Another simulation may be written where an older one is.
        assert not changed or command[0] == "simulate", command
        for name in changed:
            (folder / name).write_bytes(before[name])
        assert (folder / "store" / FILE).is_file(), command


@posix
def test_odd_command_lines_work_or_are_refused_in_one_line(tmp_path: Path, seeds: Seeds) -> None:
    survive_commands(tmp_path, seeds(0, 25))


@posix
@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(1000, 1300, 100))
def test_many_odd_command_lines_work_or_are_refused_in_one_line(tmp_path: Path, seeds: Seeds, first: int) -> None:
    survive_commands(tmp_path, seeds(first, first + 100))
