"""The command line, as a user types it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commandline import latticebench, refused, succeed
from latticebench.bench.published import read_head
from latticebench.bench.report.schema import DOCUMENTS

SHARED = Path(__file__).parents[3] / "shared" / "data" / "measured"


def document(kind: str, text: str) -> dict[str, Any]:
    """Return a document after it has been read as the kind that it should be."""
    DOCUMENTS[kind].model_validate_json(text)
    return dict(json.loads(text))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with samples of phi^4 and of the DNLS lattice."""
    place = tmp_path_factory.mktemp("cli")
    about = ("--set", "C=2", "--set", "v=0.5", "--sites", 31, "--samples", 50, "--noise", 0.001, "--seed", 1)
    succeed("simulate", "phi4", *about, "--out", "phi4.csv", cwd=place)
    succeed("simulate", "dnls", "--set", "C=0.5", "--integrator", "dop853", "--out", "dnls.parquet", cwd=place)
    return place


@pytest.mark.parametrize("kind", ["systems", "libraries", "methods", "suites", "effects"])
def test_lists_are_tables_for_people_and_json_for_programs(kind: str, tmp_path: Path) -> None:
    rows = json.loads(succeed("list", kind, "--json", cwd=tmp_path))["rows"]
    shown = succeed("list", kind, cwd=tmp_path)
    for row in rows:
        assert str(next(iter(row.values()))) in shown


def test_a_simulation_has_the_noise_and_seed_it_was_asked_for(folder: Path, tmp_path: Path) -> None:
    for name in ("a.csv", "b.csv"):
        succeed("simulate", "phi4", "--noise", 0.001, "--seed", 1, "--out", name, cwd=tmp_path)
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text() == (folder / "phi4.csv").read_text()
    header = (tmp_path / "a.csv").read_text().splitlines()[0].split(",")
    assert header == ["t", *(f"u{n}" for n in range(1, 32)), *(f"v{n}" for n in range(1, 32))]


def test_a_fit_prints_its_equation_and_writes_json_in_the_order_of_the_terms(folder: Path) -> None:
    out = succeed(
        "fit", "phi4.csv", "--system", "phi4", "--library", "lib2", "--method", "stlsq", "--set", "threshold=0.1",
        "--json", "fit.json", cwd=folder,
    )  # fmt: skip
    assert "u'' = " in out
    assert "u[n]**3" in out
    written = json.loads((folder / "fit.json").read_text())
    keys = [
        "method", "order", "coefficients", "stderr", "residual", "seconds", "status", "quality", "warnings", "units",
        "shown", "coefficient_units",
    ]  # fmt: skip
    assert list(written) == ["schema", "provenance", *keys]
    assert list(written["coefficients"]) == ["u[n+1]", "u[n-1]", "u[n]", "u[n]**3"]
    np.testing.assert_allclose(list(written["coefficients"].values()), [2, 2, -2, -2], rtol=0.02)
    assert (written["method"], written["order"], written["status"]) == ("stlsq", 2, "ok")


def test_terms_of_ones_own_are_fitted_and_named_as_they_were_given(folder: Path) -> None:
    terms = " u[n]**3;u[n+1] + u[n-1] - 2*u[n] ; u[n]"
    out = succeed(
        "fit", "phi4.csv", "--terms", terms, "--order", 2, "--method", "least-squares", "--ends", "free", "--json", "-",
        cwd=folder,
    )  # fmt: skip
    found = json.loads(out)["coefficients"]
    assert list(found) == ["u[n]**3", "u[n+1] + u[n-1] - 2*u[n]", "u[n]"]
    np.testing.assert_allclose(list(found.values()), [-2, 2, 2], rtol=0.02)


def test_a_complex_field_is_fitted_with_real_coefficients_of_t_and_i_t(folder: Path) -> None:
    out = succeed(
        "fit", "dnls.parquet", "--system", "dnls", "--library", "four", "--method", "least-squares", "--json", "-",
        cwd=folder,
    )  # fmt: skip
    found = json.loads(out)["coefficients"]
    assert abs(found["u[n+1]"]) < 0.01
    assert found["i*u[n+1]"] == pytest.approx(0.5, abs=0.01)
    assert found["i*abs(u[n])**2*u[n]"] == pytest.approx(1.0, abs=0.02)


def test_the_limit_of_a_system_has_a_verdict_for_every_term_and_says_what_more_would_need(tmp_path: Path) -> None:
    command = ["limit", "--system", "phi4", "--library", "lib3", "--noise", 0.02, "--sites", 9, "--samples", 20]
    out = succeed(*command, "--target", 0.0035, "--json", "limit.json", cwd=tmp_path)
    found = json.loads((tmp_path / "limit.json").read_text())
    assert list(found["terms"]) == ["u[n+1]", "u[n-1]", "u[n]", "u[n]**3", "u[n+2]", "u[n-2]"]
    assert found["terms"]["u[n+1]"]["coefficient"] == 2.0
    assert found["terms"]["u[n+1]"]["verdict"].startswith("known to ")
    assert "its coefficient is 0" in found["terms"]["u[n+2]"]["verdict"]
    assert (found["samples"], found["noise"]) == (20, 0.02)
    needed = found["needed"]
    assert needed["noise"] == pytest.approx(0.02 * 0.0035 / found["relative"])
    for word in ("known to", "0.35 % would need a noise level of", f"or {needed['records']} records like this one"):
        assert word in out
    untold = json.loads(
        succeed(*command, "--ends", "unknown", "--no-velocities", "--target", 1, "--json", "-", cwd=tmp_path)
    )
    assert untold["relative"] > found["relative"]


def test_the_limit_of_a_file_is_near_the_one_of_the_system_that_it_came_from(folder: Path) -> None:
    about = ["--system", "phi4", "--library", "lib2", "--json", "-"]
    told = json.loads(succeed("limit", *about, "--set", "v=0.5", "--set", "C=2", "--noise", 0.001, cwd=folder))
    found = json.loads(succeed("limit", "phi4.csv", "--ends", "free", *about, cwd=folder))
    assert found["noise"] == pytest.approx(0.001, rel=0.1)
    assert found["relative"] == pytest.approx(told["relative"], rel=0.1)
    assert found["needed"]["span"] is not None
    shown = succeed("limit", "phi4.csv", "--ends", "free", *about[:4], cwd=folder)
    assert "within reach as things are" in shown
    assert "noise of all sensors: 0.0" in shown
    assert "these bounds do not hold" not in shown
    poor = succeed("limit", "phi4.csv", "--ends", "free", "--order", 2, "--terms", "u[n+1]+u[n-1]-2*u[n]", cwd=folder)
    assert "times the noise: these bounds do not hold; see `latticebench diagnose`" in poor.splitlines()[0]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the results of the suite tiny."""
    place = tmp_path_factory.mktemp("tiny")
    out = succeed("run", "tiny", "--jobs", 1, "--results", "tiny", cwd=place)
    assert "9 cases (9 ok); 9 run now, 0 were there" in out
    assert "phi4 noise=0.01" in out
    return place


def test_a_run_its_table_its_figures_and_its_comparison(tiny: Path) -> None:
    again = succeed("run", "tiny", "--results", "tiny", cwd=tiny)
    assert "0 run now, 9 were there" in again
    found = json.loads(succeed("table", "tiny", "--out", "published", "--json", cwd=tiny))
    assert (len(found["cases"]), found["provenance"]["suite"]) == (9, "tiny")
    for name in ("cases", "coefficients", "summary", "errors"):
        for form in ("csv", "md", "tex"):
            text = (tiny / "published" / f"{name}.{form}").read_text()
            for word in ("command: latticebench run tiny", "commit: ", "machine: ", "versions: ", "seeds: 1"):
                assert word in text
    assert "known to" in (tiny / "published" / "coefficients.md").read_text()
    one = succeed("table", "tiny", "--only", "limits", "--out", "one", cwd=tiny)
    assert sorted(path.name for path in (tiny / "one").iterdir()) == ["limits.csv", "limits.md", "limits.tex"]
    assert "bound" in one
    assert "unknown figure 'cots'; did you mean 'cost'" in refused("figures", "tiny", "--only", "cots", cwd=tiny)
    files = succeed("figures", "tiny", "--out", "published", cwd=tiny).split()
    assert {Path(file).name for file in files} >= {"errors.png", "error-against-seconds.png", "error-against-noise.png"}
    assert all((tiny / file).stat().st_size > 5000 for file in files)
    assert "0 losses, 0 gains, 9 the same" in succeed("compare", "tiny", "published", cwd=tiny)


def test_a_dry_run_says_what_is_there_and_writes_nothing(tiny: Path) -> None:
    before = sorted(tiny.rglob("*"))
    out = succeed("run", "tiny", "--results", "tiny", "--dry-run", cwd=tiny)
    assert "9 cases, 9 of them finished in tiny; 0 to run" in out
    other = succeed("run", "tiny", "--results", "new", "--methods", "stlsq", "--seeds", "1-5", "--dry-run", cwd=tiny)
    assert "15 cases, 0 of them finished in new; 15 to run" in other
    assert "there is nothing to estimate from" in other
    again = succeed(
        "run", "tiny", "--results", "tiny", "--methods", "stlsq", "--seeds", "2", "--jobs", 1, "--dry-run", cwd=tiny
    )
    assert "by what 3 of the 3 took in tiny" in again
    assert sorted(tiny.rglob("*")) == before


def test_stores_are_merged_into_one_that_can_be_shown(tiny: Path) -> None:
    assert "9 results in merged" in succeed("merge", "tiny", "--out", "merged", cwd=tiny)
    assert succeed("table", "merged", cwd=tiny) == succeed("table", "tiny", cwd=tiny)
    assert sorted(path.name for path in (tiny / "merged").iterdir()) == ["results.sqlite"]


def test_a_method_in_one_file_stands_beside_the_paper_after_three_commands(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    shutil.copy(root / "docs" / "data" / "ridge.py", tmp_path / "mine.py")
    paper = root / "results" / "paper"
    only = ["--only", "1[abc]", "--only", "2a, noise"]
    succeed("run", "paper", "--methods", "mine.py", *only, "--results", "mine", "--jobs", 1, cwd=tmp_path)
    shown = succeed("table", "mine", "--with", paper, "--out", "published", cwd=tmp_path)
    assert "stlsq*" in shown
    commit = read_head(paper / "cases.csv")["commit"]
    assert f"* published: results/paper, commit {commit}" in shown
    table = (tmp_path / "published" / "errors.tex").read_text()
    assert all(f"\n{part} & " in table for part in ("1a", "1b", "1c", "2a, noise"))
    assert "& {mine} & {pinn*} &" in table
    succeed("figures", "mine", "--with", paper, "--only", "errors", "--out", "errors.pdf", cwd=tmp_path)
    assert (tmp_path / "errors.pdf").read_bytes().startswith(b"%PDF")
    told = succeed("compare", "mine", "--with", paper, "--against", "stlsq", "--out", "ranks.svg", cwd=tmp_path)
    assert "not told apart" in told
    assert "mean rank of E2 over 4 cases" in told
    assert (tmp_path / "ranks.svg").read_text().startswith("<?xml")
    succeed("compare", "mine", "--with", paper, "--against", "mine", "--out", "against.csv", cwd=tmp_path)
    assert "published: results/paper" in (tmp_path / "against.csv").read_text()
    written = succeed("compare", "mine", "--with", paper, "--against", "mine", "--out", "all", cwd=tmp_path).split()
    assert {Path(path).name for path in written if path.startswith("all")} == {
        "ranks.png", *(f"{name}.{form}" for name in ("against", "against-cases") for form in ("csv", "md", "tex"))
    }  # fmt: skip
    assert (tmp_path / "all" / "against-cases.csv").read_text().count("\n1a,phi4 C=2 v=0.5,lib1,") == 8
    assert "unknown ending '.gif'" in refused(
        "figures", "mine", "--only", "errors", "--out", "errors.gif", cwd=tmp_path
    )
    rows = document("run", succeed("table", "mine", "--with", paper, "--json", cwd=tmp_path))["cases"]
    assert {row["published"] for row in rows if row["method"].startswith("stlsq")} == {commit}
    assert {row["published"] for row in rows if row["method"] == "mine"} == {""}
    found = document(
        "against", succeed("compare", "mine", "--with", paper, "--against", "mine", "--json", cwd=tmp_path)
    )
    assert found["published"].startswith("results/paper")
    assert len(found["cases"]) == sum(row["cases"] for row in found["methods"]) > 7
    assert found["ranks"]["cases"] == 4
    about = ("--with", paper, "--only", "errors", "--out", "a.svg", "--json")
    assert document("figures", succeed("figures", "mine", *about, cwd=tmp_path))["files"] == ["a.svg"]
    lone = refused("table", "mine", "--with", root / "results" / "limits", cwd=tmp_path)
    assert "it has none of these cases" in lone


def test_comparing_names_what_got_worse_and_exits_with_1(tiny: Path) -> None:
    succeed("table", "tiny", "--out", "old", cwd=tiny)
    table = (tiny / "old" / "cases.csv").read_text()
    assert "0.00763" in table or "0.0076" in table
    import pandas as pd

    frame = pd.read_csv(tiny / "old" / "cases.csv", comment="#")
    frame.loc[(frame.method == "stlsq") & (frame.noise == 0.01), "e2"] /= 10
    frame.to_csv(tiny / "better.csv", index=False)
    code, worse, _ = latticebench("compare", "better.csv", "tiny", cwd=tiny)
    assert code == 1
    assert "loss: phi4 noise=0.01 | lib2 | stlsq | seed 1" in worse
    better = succeed("compare", "tiny", "better.csv", "--json", cwd=tiny)
    assert len(json.loads(better)["better"]) == 1


def test_a_method_and_a_system_from_outside_work_without_touching_the_project(tmp_path: Path) -> None:
    (tmp_path / "guess.py").write_text(
        "from dataclasses import dataclass\nfrom typing import ClassVar\nimport numpy as np\n"
        "from latticebench.methods.engine.regression import rows\n"
        "from latticebench.methods.method import Abilities, Fit\n\n"
        "@dataclass(frozen=True)\nclass Guess:\n    'Least squares, rounded to a grid.'\n\n"
        "    name: ClassVar[str] = 'guess'\n    grid: float = 0.5\n\n"
        "    @property\n    def abilities(self):\n        return Abilities()\n\n"
        "    def fit(self, data, library, order, seed):\n"
        "        regression = rows(data, library, order, 'spline')\n"
        "        found = np.round(regression.least_squares() / self.grid) * self.grid\n"
        "        return Fit(self.name, library, order, found, regression.residual(found))\n\nMETHODS = (Guess,)\n"
    )
    (tmp_path / "toda.toml").write_text(
        'name = "toda"\nequation = "k*(exp(u[n+1]-u[n]) - exp(u[n]-u[n-1]))"\norder = 2\nends = "fixed"\nsites = 9\n'
        '[parameters]\nk = 1.5\n[initials.bump]\nu = "exp(-x**2)"\n'
        '[libraries]\ntoda = ["exp(u[n+1]-u[n])", "exp(u[n]-u[n-1])", "u[n]"]\n'
    )
    (tmp_path / "mine.toml").write_text(
        'title = "from outside"\n[methods.rounded]\nmethod = "guess.py"\nsettings = { grid = 0.25 }\n'
        '[[grid]]\nsystem = "toda.toml"\nlibraries = ["toda"]\nparameters = { k = [0.5, 1.5] }\nspan = 5\n'
    )
    rows = json.loads(succeed("run", "mine.toml", "--results", "out", "--json", cwd=tmp_path))["cases"]
    assert [row["e2"] for row in rows] == [0.0, 0.0]
    succeed("simulate", "toda.toml", "--span", 5, "--out", "toda.csv", cwd=tmp_path)
    out = succeed(
        "fit", "toda.csv", "--system", "toda.toml", "--library", "toda", "--method", "guess.py", "--json", "-",
        cwd=tmp_path,
    )  # fmt: skip
    assert list(json.loads(out)["coefficients"].values()) == [1.5, -1.5, 0.0]


def measured(name: str) -> Path:
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"the recording {name} does not lie beside the project")
    return path


def test_the_measured_gliders_give_the_stiffness_of_their_source(tmp_path: Path) -> None:
    terms = "u[n+1]+u[n-1]; n*(u[n+1]+u[n-1]); u[n]; n*u[n]; v[n]; 1; n"
    out = succeed(
        "fit", measured("gliders.csv"), "--terms", terms, "--order", 2, "--ends", "fixed", "--method", "least-squares",
        "--json", "-", cwd=tmp_path,
    )  # fmt: skip
    mean, slope, diagonal, difference, *_ = json.loads(out)["coefficients"].values()
    # n = -1/2 and +1/2: the coefficients are the mean and the difference of the two sites' springs.
    stiffness = [
        [-(diagonal - difference / 2), -(mean - slope / 2)],
        [-(mean + slope / 2), -(diagonal + difference / 2)],
    ]
    np.testing.assert_allclose(stiffness, [[85.76, -77.98], [-31.48, 34.59]], rtol=0.02)


def test_the_measured_pendulum_gives_its_frequency_and_damping(tmp_path: Path) -> None:
    out = succeed(
        "fit", measured("pendulum.csv"), "--terms", "sin(u[n]); v[n]", "--order", 2, "--method", "least-squares",
        "--json", "-",
        cwd=tmp_path,
    )  # fmt: skip
    found = json.loads(out)
    assert found["coefficients"]["sin(u[n])"] == pytest.approx(-64.2, rel=0.01)
    assert found["coefficients"]["v[n]"] == pytest.approx(-0.0672, rel=0.3)
    assert found["residual"] < 0.006


def test_a_command_uses_one_thread_unless_the_environment_asks_for_more(tmp_path: Path) -> None:
    program = (
        "import sys; sys.argv = ['latticebench', 'list', 'systems']\n"
        "from latticebench.bench.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "import numpy, threadpoolctl\n"
        "print(max(pool['num_threads'] for pool in threadpoolctl.threadpool_info()))"
    )
    for asked, found in (({}, 1), ({"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}, 2)):
        plain = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=tmp_path, env=plain | asked, capture_output=True, text=True, check=True
        )
        assert int(done.stdout.split()[-1]) == min(found, os.cpu_count() or 1)
