"""Keys: a result is computed again when the code that decides it changes, and only then."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from latticebench.bench.case import Folders, Roots
from latticebench.bench.fitting import FitCase
from latticebench.bench.source import files
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Trial

ROOT = Path(__file__).parents[2]
CASES = {
    "weak fit": FitCase(system="phi4", library="lib1", label="a", method="weak"),
    "network": FitCase(system="phi4", library="lib1", label="a", method="pinn"),
    "trial": Trial(system="phi4", effect="damping"),
    "recording": Measured(name="x", file="x.csv", terms="u[n]", order=2),
}


def files_of(roots: Roots) -> set[str]:
    return {path.relative_to(ROOT).as_posix() for path in files(roots, Folders())}


@pytest.mark.parametrize("name", CASES)
def test_pages_tables_the_runner_the_suite_parser_and_the_command_line_decide_no_result(name: str) -> None:
    found = files_of(CASES[name].roots)
    others = {
        "suite", "grid", "run", "pool", "worker", "store", "source", "kinds", "tables", "publish", "figures", "compare",
        "report/screen", "report/text", "report/page", "report/pictures", "report/curves", "report/rows",
        "report/outputs", "trials/scores", "trials/recorded",
    }  # fmt: skip
    without = {f"bench/{other}.py" for other in others}
    assert all((ROOT / file).is_file() for file in without)
    assert not found & without
    assert not any(path.startswith("bench/cli/") for path in found)


def test_each_kind_of_case_depends_on_its_own_code_and_on_what_that_imports() -> None:
    found = {name: files_of(case.roots) for name, case in CASES.items()}
    assert {"bench/fitting.py", "bench/score.py", "bench/limit.py", "methods/weak.py", "systems/phi4.py"} <= found[
        "weak fit"
    ]
    assert "methods/pinn.py" in found["network"] - found["weak fit"]
    assert {"bench/trials/trial.py", "bench/trials/specimen.py", "diagnosis/repair.py", "systems/effects.py"} <= found[
        "trial"
    ]
    assert any(path.startswith("bench/trials/faults/") for path in found["trial"])
    assert "bench/fitting.py" not in found["trial"] | found["recording"]
    assert {"bench/trials/measured.py", "diagnosis/repair.py"} <= found["recording"]
    assert not any(path.startswith("bench/trials/faults/") for path in found["recording"])


# Changes one file of a copied package after another; keys are made of files, so that one process sees them all.
PROGRAM = """
import json, os, re, sys
from pathlib import Path
sys.path.insert(0, ".")
from latticebench.bench import source
from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase
from latticebench.bench.trials.trial import Trial
assert Path(source.__file__).is_relative_to(Path().resolve())
cases = {
    "weak": FitCase(system="phi4", library="lib1", label="a", method="weak"),
    "other": FitCase(system="dnls", library="four", label="a", method="stlsq"),
    "trial": Trial(system="phi4", effect="damping"),
}
def keys():
    return {name: source.keys({case.identity: case}, Folders())[case.identity] for name, case in cases.items()}
def write(path, text, clock=iter(range(10**18, 2 * 10**18, 10**9))):
    path.write_text(text)
    now = next(clock)  # A file system may not tell two writes in a row apart.
    os.utime(path, ns=(now, now))
before, told = keys(), {}
for name in json.loads(sys.argv[1]):
    path = Path("latticebench") / name
    text = path.read_text()
    write(path, re.sub(r'^\"\"\"', '\"\"\"Differently: ', text, count=1) + "\\n# a remark\\n")
    remark = keys()
    write(path, text + "\\nCHANGED = True\\n")
    changed = keys()
    write(path, text)
    told[name] = [[case for case in cases if found[case] != before[case]] for found in (remark, changed)]
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package, to change files in."""
    folder = tmp_path_factory.mktemp("copy")
    skipped = shutil.ignore_patterns("__pycache__")
    for room in ("systems", "methods", "diagnosis", "bench"):
        shutil.copytree(ROOT / room, folder / "latticebench" / room, ignore=skipped)
    for file in (ROOT / "latticebench").glob("*.py"):
        shutil.copy(file, folder / "latticebench")
    return folder


CHANGES = {
    "bench/report/page.py": set(), "bench/cli/run.py": set(), "bench/publish.py": set(), "bench/run.py": set(),
    "bench/suite.py": set(), "bench/store.py": set(), "methods/weak.py": {"weak"}, "systems/phi4.py": {"weak", "trial"},
    "diagnosis/repair.py": {"trial"}, "bench/score.py": {"weak", "other"},
    "methods/engine/regression.py": {"weak", "other", "trial"},
}  # fmt: skip


def test_a_change_of_a_module_runs_again_what_uses_it_and_nothing_else(copy: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(list(CHANGES))], capture_output=True, text=True, cwd=copy
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found == {name: [[], sorted(rerun, key=["weak", "other", "trial"].index)] for name, rerun in CHANGES.items()}
