"""Methods and systems of other packages: installed as pip installs them, found by their entry points."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from commandline import succeed
from latticebench import methods, systems
from latticebench.bench.choice import chosen
from latticebench.bench.run import run
from latticebench.bench.source import keys
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.systems.errors import InputError

ROOT = Path(__file__).parents[2]
SUITE = """
[methods.theirs]
method = "{method}"
{settings}

[methods.floor]
method = "zero"

[[grid]]
system = "{system}"
sites = 9
libraries = ["own"]
"""
SYSTEM = """
from latticebench.systems.lattice import Initial, System, library

SYSTEM = System(
    name="springs", title="Springs", equation="k*(u[n+1]+u[n-1]-2*u[n])", order=2, is_complex=False,
    parameters={"k": 2.0},
    initials={"bump": Initial(u="exp(-x**2)")}, libraries=(library("own", "u[n+1]; u[n-1]; u[n]"),), source="a test",
)
"""


def install(site: Path, name: str, methods: dict[str, str], systems: dict[str, str]) -> None:
    """Write what pip leaves of a package, but for its modules."""
    about = site / f"{name}-1.2.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    groups = {"latticebench.methods": methods, "latticebench.systems": systems}
    lines = (
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
        for group, entries in groups.items()
    )  # fmt: skip
    (about / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install a package with a method and a system, and one that cannot be imported."""
    place = tmp_path / "site"
    install(place, "good", {"their-ridge": "good_fits.ridge:Ridge"}, {"springs": "good_fits.springs:SYSTEM"})
    broken = "broken_fits:Method"
    install(place, "broken", {"broken": broken, "zero": broken, "shapeless": "broken_shape:SHAPE"}, {"lost": broken})
    package = place / "good_fits"
    package.mkdir()
    (package / "__init__.py").touch()
    shutil.copy(ROOT / "docs" / "data" / "ridge.py", package / "ridge.py")
    (package / "springs.py").write_text(SYSTEM)
    (place / "broken_fits.py").write_text("import a_module_that_is_not_there\n")
    (place / "broken_shape.py").write_text("SHAPE = 3\n")
    monkeypatch.syspath_prepend(place)
    before = set(sys.modules)
    yield place
    for name in set(sys.modules) - before:
        if name.startswith(("good_", "broken_")):
            del sys.modules[name]


def write(folder: Path, method: str, system: str = "springs", settings: str = "") -> str:
    path = folder / "mine.toml"
    path.write_text(SUITE.format(method=method, system=system, settings=settings))
    return str(path)


def test_a_method_and_a_system_of_an_installed_package_are_found_by_name(site: Path, tmp_path: Path) -> None:
    assert "their-ridge" in methods.brought()
    assert "good_fits" not in sys.modules
    suite = load(write(tmp_path, "their-ridge", settings="settings = { weight = 1e-9 }"))
    assert "good_fits" not in sys.modules, "a run imports them in its workers alone"
    results, _ = run(suite, create(tmp_path / "store"), jobs=1)
    found = {result["case"]["label"]: result for result in results}
    assert {result["status"] for result in found.values()} == {"ok"}
    assert found["theirs"]["e2"] < 0.01 < found["floor"]["e2"]
    assert methods.find("their-ridge").name == "ridge"
    assert systems.find("springs").parameters == {"k": 2.0}
    assert list(load("tiny", choice=chosen(None, ["their-ridge"])).contestants) == ["their-ridge"]


def test_what_cannot_be_imported_is_a_row_that_names_the_package(site: Path, tmp_path: Path) -> None:
    told = (
        "package broken 1.2: '{}' cannot be imported from broken_fits:Method: ModuleNotFoundError: No module named "
        "'a_module_that_is_not_there'"
    )
    for number, (method, system) in enumerate([("broken", "springs"), ("their-ridge", "lost")]):
        results, _ = run(load(write(tmp_path, method, system)), create(tmp_path / f"{number}"), jobs=1)
        rows = {result["case"]["label"]: result for result in results}
        assert rows["theirs"]["status"] == "failed"
        assert rows["theirs"]["reason"] == told.format("broken" if number == 0 else "lost")
        assert rows["floor"]["status"] == ("ok" if number == 0 else "failed")
    with pytest.raises(InputError, match=r"package broken 1\.2"):
        methods.find("broken")
    with pytest.raises(InputError, match=r"package broken 1\.2: method 3 has no 'name'"):
        methods.find("shapeless")


@pytest.mark.parametrize(
    ("kind", "good", "bad"), [("methods", "their-ridge", "broken"), ("systems", "springs", "lost")]
)
def test_lists_show_them_and_say_which_package_fails(site: Path, kind: str, good: str, bad: str) -> None:
    out = succeed("list", kind, "--json", cwd=site)
    rows = {row["name"]: row for row in json.loads(out)["rows"]}
    assert good in rows
    assert "package broken 1.2" in str(rows[bad])


def test_a_name_of_this_package_stays_its_own_and_unknown_ones_are_told_all(site: Path) -> None:
    assert methods.find("zero").__module__ == "latticebench.methods.zero"
    assert "zero" not in methods.brought()
    with pytest.raises(InputError, match="did you mean 'their-ridge'"):
        methods.find("their-rige")
    with pytest.raises(InputError, match="did you mean 'springs'"):
        systems.find("sprins")


def test_a_changed_module_of_the_package_runs_its_cases_again(site: Path, tmp_path: Path) -> None:
    suite = load(write(tmp_path, "their-ridge"))
    before = keys(suite.by_identity, suite.folders)
    (site / "good_fits" / "weights.py").write_text("WEIGHT = 1\n")
    after = keys(suite.by_identity, suite.folders)
    assert all(before[one] != after[one] for one in before)


def test_without_other_packages_there_is_nothing_brought() -> None:
    assert not set(methods.brought()) & set(methods.registered())
    assert not set(systems.brought()) & set(systems.names())


def test_what_has_a_name_of_ours_is_listed_as_not_used(site: Path, tmp_path: Path) -> None:
    rows = json.loads(succeed("list", "methods", "--json", cwd=tmp_path))["rows"]
    ours, theirs = [row["what it is"] for row in rows if row["name"] == "zero"]
    assert theirs == "package broken 1.2: not used, since latticebench has 'zero' itself; it needs another name"
    assert "package" not in ours
