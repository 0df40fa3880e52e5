"""Change the code in one place at a time and see whether the tests notice: mutants.csv and mutants.md.

    make mutants
    python results/mutants/mutants.py [--count N] [--again]

Mutants come from cosmic-ray: an operator, a comparison, a number or a truth value is replaced, an exception or a
decorator is another or none, a loop does not run. Of each module below as many are drawn as `--count` says, all if it
is 0. Each is tried in a copy of the work tree on the quick tests that are nearest to its module, and if these let it
pass, on those that are near. What survives is listed with the line that was changed. With `--again` those that survived
before are tried again, as tests have come since; `commit` is that of the trial. Replaced `|` are left out: they are in
annotations, which nothing evaluates.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.escape import csv_text
from latticebench.bench.provenance import origin
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.published import read_head
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ROOMS = ("systems", "methods", "diagnosis", "bench")
# What every method is asked.
CONTRACT = "methods/test_contract.py test_house.py"
# Modules, with the tests that are nearest and those that are near.
MODULES = {
    "bench/score.py": ("bench/test_score.py", "bench/test_fitting.py bench/test_run.py test_house.py"),
    "bench/case.py": (
        "bench/test_fitting.py bench/test_suite.py", "bench/test_store.py bench/test_run.py test_house.py"),
    "bench/limit.py": ("bench/test_limit.py", "bench/test_door.py"),
    "bench/compare.py": ("bench/test_compare.py", "bench/test_cli.py bench/trials/test_judging.py"),
    "bench/store.py": ("bench/test_store.py", "bench/test_run.py bench/test_full.py bench/test_choice.py"),
    "systems/terms.py": ("systems/test_terms.py", "systems/test_systems.py systems/test_parser.py"),
    "systems/stencil.py": (
        "systems/test_stencil.py systems/test_motion.py", "systems/test_systems.py methods/test_streaming.py"),
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
    "methods/trajectory.py": ("methods/test_trajectory.py", f"methods/test_windows.py {CONTRACT}"),
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
COLUMNS = ["module", "line", "operator", "noticed by", "changed to", "commit"]
# Why a mutant that survived does what the code does, by its line as it was changed.
EQUAL: dict[str, str] = {
    'return value if math.isfinite(value) else ("inf" if value >= 0 else "-inf")': "an infinite number is not 0",
    "positive = d[d > 1e-12 * d[- 0]]": "-0 is 0",
    "HOPELESS, TRIED = 10**9, 11**5": "another bound on what is tried",
    "needed[open_] *= 3": "more steps than are needed",
    "alike = np.flatnonzero(substeps >= number)": "what needs more steps is done again with more",
    "target[:, -1] = np.transpose(product, (2, 1, 0)).reshape(target[:, ~1].shape)": "another place of the same shape",
    "return Abilities(missing=True, motion=True, memory= 2501, window=WIDE, loads=LOADS)": "an estimate of memory",
    "yield from (list(some) for some in _batched(cut(samples, library.reach), max(1, WIDE + WINDOW)))": "other batches",
    'if not {"results", "origins", "suite", "about"} < names:': "a store has further tables",
    "rows, seen = (*self.rows, piece), self.seen ^ len(piece.target)": "another seed of a draw",
    "points = slice(int(some[0]), int(some[-1]) // 1)": "a test function is nearly 0 at the last of its points",
    "def _connect(path: Path, mode: str, /, fresh: bool = False) -> sqlite3.Connection:": "how it may be called",
    "point = {one: (0.3 % 0.1 * k) + (0 if one.is_real else 0.2j) for k, one in enumerate(symbols)}": "another point",
    "if not noise * max(float(np.max(np.abs(clean.u[some]))) for some in rows_of(clean.u)) < 1e+300:": "adds 1",
    "most = max(1, PIECE // (len(t) * len(library.terms) * (1 << samples.is_complex)))": "2 to the power 0 or 1",
    "if len(regression.target) <= regression.design.shape[1] // 1:": "a triangle of as many rows has the same sums",
}


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


def tried(module: str, mutations: Iterable[Any], commit: str) -> Iterator[tuple[Any, ...]]:
    """Try mutants of a module; the working folder is the copy."""
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_item import TestOutcome

    for mutation in mutations:
        by, line = "", ""
        for stage, tests in zip(("nearest", "near"), MODULES[module], strict=True):
            files = " ".join(f"tests/{name}" for name in tests.split())
            command = f"{shlex.quote(sys.executable)} -m pytest -x -q --benchmark-disable -m 'not slow' {files}"
            result = mutate_and_test([mutation], f"{command} -p no:cacheprovider -p no:randomly", LIMIT)
            line = next((one[1:].strip() for one in (result.diff or "").splitlines()[4:] if one[:1] == "+"), "")
            if result.test_outcome != TestOutcome.SURVIVED:
                by = stage
                break
        row = (module, mutation.start_pos[0], _operator(mutation), by or "survived", line, commit)
        print(*row, flush=True)
        yield row


def _operator(mutation: Any) -> str:
    return str(mutation.operator_name.partition("/")[2])


def known(before: pd.DataFrame, module: str, mutations: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Return the rows of these mutants in an earlier table; none if the module has changed since."""
    rows = list(before[before["module"] == module].itertuples(index=False, name=None))
    same = [row[1:3] for row in rows] == [(one.start_pos[0], _operator(one)) for one in mutations]
    return rows if same else []


def intervals(noticed: int, count: int) -> str:
    """Return a share with its 95 % interval (Clopper & Pearson, Biometrika 26, 404 (1934))."""
    from scipy.stats import binomtest

    found = binomtest(noticed, count).proportion_ci(0.95)
    return f"{100 * noticed / count:.0f} % [{100 * found.low:.0f}, {100 * found.high:.0f}]"


def _counted(name: str, group: pd.DataFrame) -> dict[str, Any]:
    """Return what became of the mutants of a module."""
    by = group["noticed by"].value_counts()
    nearest, near = int(by.get("nearest", 0)), int(by.get("near", 0))
    same = int((group["noticed by"].eq("survived") & group["why"].ne("")).sum())
    return {
        "module": name, "mutants": len(group), "noticed by the nearest tests": nearest, "by near ones": near,
        "do the same": same, "noticed [95 %]": intervals(nearest + near, len(group)),
        "of those that do something else [95 %]": intervals(nearest + near, len(group) - same),
    }  # fmt: skip


def page() -> str:
    """Return the text of mutants.md, made from mutants.csv beside this file."""
    table = _table()
    table["why"] = [EQUAL.get(text, "") for text in table["changed to"]]
    survived = table["noticed by"] == "survived"
    groups = [*table.groupby("module", sort=False), ("all", table)]
    short = pd.DataFrame([_counted(str(name), group) for name, group in groups])
    about = "".join(f"- {name}: {told}\n" for name, told in read_head(HERE / "mutants.csv").items())
    return (
        "# Mutants\n\nMade by `make mutants` (`results/mutants/mutants.py`, which says what is changed and which tests "
        f"are asked).\n\n{markdown_table(short)}\n\nWhat survives, as the line was changed, and why it does the same "
        f"where it does:\n\n{markdown_table(table[survived].drop(columns=['noticed by', 'commit']))}\n\n{about}"
    )


def _table() -> pd.DataFrame:
    path = HERE / "mutants.csv"
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    table = pd.read_csv(path, comment="#", keep_default_na=False)
    return table.map(lambda cell: csv_text(cell) if isinstance(cell, str) else cell)


def main() -> None:
    """Try the mutants, and write the two files after each module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="mutants per module; 0 for all")
    parser.add_argument("--again", action="store_true", help="try only those that survived before")
    given = parser.parse_args()
    command = f"python results/mutants/mutants.py --count {given.count}" + " --again" * given.again
    about = {"command": command, **origin(), "seed": SEED}
    before = _table() if given.again else pd.DataFrame(columns=COLUMNS)
    rows: list[tuple[Any, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder).resolve())
        for module in MODULES:
            os.chdir(copy)
            mutations = drawn(module, given.count)
            earlier = known(before, module, mutations)
            noticed = {place: row for place, row in enumerate(earlier) if row[3] != "survived"}
            new = tried(module, [one for place, one in enumerate(mutations) if place not in noticed], about["commit"])
            rows += [noticed[place] if place in noticed else next(new) for place in range(len(mutations))]
            os.chdir(ROOT)
            write_text(HERE / "mutants.csv", render(pd.DataFrame(rows, columns=COLUMNS), about, "csv"))
            write_text(HERE / "mutants.md", page())


if __name__ == "__main__":
    main()
