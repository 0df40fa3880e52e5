"""Change the code in one place at a time and see whether the tests notice: mutants.csv and mutants.md.

    make mutants

Mutants come from cosmic-ray: an operator, a comparison, a number or a truth value is replaced, an exception or a
decorator is another or none, a loop does not run. Of each module below as many are drawn as `--count` says, all if it
is 0. Each is tried in a copy of the work tree on the quick tests that are nearest to its module, and if these let it
pass, on those that are near. What survives is listed with the line that was changed. Replaced `|` are left out: they
are in annotations, which nothing evaluates.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.provenance import origin
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.published import read_head
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ROOMS = ("systems", "methods", "diagnosis", "bench")
# What every method is asked.
CONTRACT = "methods/test_contract.py"
# Modules, with the tests that are nearest and those that are near.
MODULES = {
    "bench/score.py": ("bench/test_score.py", "bench/test_fitting.py bench/test_run.py"),
    "bench/case.py": ("bench/test_fitting.py bench/test_suite.py", "bench/test_store.py bench/test_run.py"),
    "bench/limit.py": ("bench/test_limit.py", "bench/test_door.py"),
    "bench/compare.py": ("bench/test_compare.py", "bench/test_cli.py"),
    "bench/store.py": ("bench/test_store.py", "bench/test_run.py bench/test_full.py"),
    "systems/terms.py": ("systems/test_terms.py", "systems/test_systems.py systems/test_parser.py"),
    "systems/stencil.py": ("systems/test_stencil.py systems/test_motion.py", "systems/test_systems.py"),
    "systems/simulate.py": ("systems/test_simulate.py systems/test_observe.py", "systems/test_motion.py"),
    "methods/engine/derivatives.py": ("methods/engine/test_derivatives.py methods/test_sindy.py", CONTRACT),
    "methods/engine/regression.py": ("methods/test_sindy.py methods/test_streaming.py", CONTRACT),
    "methods/sindy_tuned.py": ("methods/test_sindy_tuned.py", CONTRACT),
    "methods/e_sindy.py": ("methods/test_e_sindy.py", CONTRACT),
    "methods/engine/weak_form.py": ("methods/engine/test_weak_form.py methods/test_weak.py", CONTRACT),
    "methods/engine/errors_in_variables.py": (
        "methods/engine/test_errors_in_variables.py methods/test_weak.py", CONTRACT),
    "methods/weak_stlsq.py": ("methods/test_weak_stlsq.py", CONTRACT),
    "methods/engine/sensitivity.py": (
        "methods/engine/test_sensitivity.py methods/engine/test_shooting.py", f"methods/test_trajectory.py {CONTRACT}"),
    "methods/engine/shooting.py": (
        "methods/engine/test_shooting.py methods/test_trajectory.py", f"bench/test_limit.py {CONTRACT}"),
    "methods/trajectory.py": ("methods/test_trajectory.py", CONTRACT),
    "methods/engine/collocation.py": (
        "methods/engine/test_collocation.py methods/engine/test_spline_state.py",
        f"methods/test_splines.py methods/test_pielm.py {CONTRACT}"),
    "methods/splines.py": ("methods/test_splines.py", CONTRACT),
    "methods/engine/networks/descent.py": ("methods/engine/networks/test_descent.py methods/test_pinn.py", CONTRACT),
    "methods/engine/networks/loss.py": ("methods/engine/networks/test_loss.py methods/test_pinn.py", CONTRACT),
    "methods/pinn.py": ("methods/test_pinn.py", CONTRACT),
    "methods/pielm.py": ("methods/test_pielm.py", CONTRACT),
    "methods/engine/networks/projection.py": (
        "methods/engine/networks/test_projection.py methods/test_pielm.py", f"methods/test_pinn_gn.py {CONTRACT}"),
    "methods/pinn_gn.py": ("methods/test_pinn_gn.py", CONTRACT),
}  # fmt: skip
LIMIT = 600.0
SEED = 1


def copied(folder: Path) -> Path:
    """Copy what git tracks to a folder in which the rooms are imported from the copy."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, listed.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    for room in ROOMS:
        (folder / "latticebench" / room).symlink_to(folder / room)
    return folder


def drawn(module: str, count: int) -> list[Any]:
    """Return mutations of a module, in the order of its lines."""
    from cosmic_ray.commands import init
    from cosmic_ray.work_db import WorkDB, use_db

    with use_db(":memory:", WorkDB.Mode.create) as database:
        init([Path(module)], database, {})
        every = [one for item in database.work_items for one in item.mutations if "BitOr" not in one.operator_name]
    every.sort(key=lambda one: (one.start_pos, one.operator_name, one.occurrence))
    if not count or count >= len(every):
        return every
    chosen = np.random.default_rng(SEED).choice(len(every), count, replace=False)
    return [every[place] for place in sorted(chosen)]


def tried(module: str, count: int) -> Iterator[tuple[Any, ...]]:
    """Try the mutants of a module; the working folder is the copy."""
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_item import TestOutcome

    for mutation in drawn(module, count):
        by, line = "", ""
        for stage, tests in zip(("nearest", "near"), MODULES[module], strict=True):
            files = " ".join(f"tests/{name}" for name in tests.split())
            command = f"{shlex.quote(sys.executable)} -m pytest -x -q --benchmark-disable -m 'not slow' {files}"
            result = mutate_and_test([mutation], f"{command} -p no:cacheprovider -p no:randomly", LIMIT)
            line = next((one[1:].strip() for one in (result.diff or "").splitlines()[4:] if one[:1] == "+"), "")
            if result.test_outcome != TestOutcome.SURVIVED:
                by = stage
                break
        row = (module, mutation.start_pos[0], mutation.operator_name.partition("/")[2], by or "survived", line)
        print(*row, flush=True)
        yield row


def intervals(noticed: int, count: int) -> str:
    """Return a share with its 95 % interval (Clopper & Pearson, Biometrika 26, 404 (1934))."""
    from scipy.stats import binomtest

    found = binomtest(noticed, count).proportion_ci(0.95)
    return f"{100 * noticed / count:.0f} % [{100 * found.low:.0f}, {100 * found.high:.0f}]"


def page() -> str:
    """Return the text of mutants.md, made from mutants.csv beside this file."""
    table = pd.read_csv(HERE / "mutants.csv", comment="#", keep_default_na=False)
    groups = [*table.groupby("module", sort=False), ("all", table)]
    short = pd.DataFrame(
        [
            (name, len(group), int(group["noticed by"].eq("nearest").sum()), int(group["noticed by"].eq("near").sum()),
             intervals(int(group["noticed by"].ne("survived").sum()), len(group)))
            for name, group in groups
        ],
        columns=["module", "mutants", "noticed by the nearest tests", "by near ones", "noticed [95 %]"],
    )  # fmt: skip
    left = table[table["noticed by"] == "survived"].drop(columns="noticed by")
    about = "".join(f"- {name}: {told}\n" for name, told in read_head(HERE / "mutants.csv").items())
    return (
        "# Mutants\n\nMade by `make mutants` (`results/mutants/mutants.py`, which says what is changed and which tests "
        f"are asked).\n\n{markdown_table(short)}\n\nWhat survives, as the line was changed:\n\n"
        f"{markdown_table(left)}\n\n{about}"
    )


def main() -> None:
    """Try the mutants, and write the two files after each module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="mutants per module; 0 for all")
    given = parser.parse_args()
    about = {"command": f"python results/mutants/mutants.py --count {given.count}", **origin(), "seed": SEED}
    rows: list[tuple[Any, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder).resolve())
        for module in MODULES:
            os.chdir(copy)
            rows += tried(module, given.count)
            os.chdir(ROOT)
            table = pd.DataFrame(rows, columns=["module", "line", "operator", "noticed by", "changed to"])
            write_text(HERE / "mutants.csv", render(table, about, "csv"))
            write_text(HERE / "mutants.md", page())


if __name__ == "__main__":
    main()
