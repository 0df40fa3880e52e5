"""Bad input on the command line: each is one clear line and exit code 2, and nothing is written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from commandline import refused, succeed, unchanged

BAD_FILES = {
    "no-t.csv": ("u1,u2\n1,2\n3,4\n", "no column t"),
    "text.csv": ("t,u1\n0,1\n1,one\n2,3\n", "row 2, column u1: 'one' is not a number"),
    "back.csv": ("t,u1\n0,1\n2,2\n1,3\n", "row 3, column t"),
    "one.csv": ("t,u1\n0,1\n", "1 row(s)"),
    "short.csv": (
        "t,u1,u2\n" + "".join(f"{k},{k},{k * k}\n" for k in range(9)),
        "stencil needs 3 sites, the data have 2",
    ),
    "nan.csv": ("t,u1,u2,u3\n0,,,\n1,,,\n2,,,\n", "every value of u is missing"),
    "empty.csv": ("", "empty"),
    "void.parquet": ("", "empty"),
    "words.csv": ("\x00\x01\xff", "words.csv"),
    "gap.csv": ("t,u1,u3\n0,1,1\n1,1,1\n", "column u2 is missing"),
    "ragged.csv": ("t,u1\n0,1\n1,2,3,4\n", "not a table"),
    "notes.odt": ("hello", "ending '.odt'"),
    "notes.txt": ("hello", "there is no column t"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_one_clear_line_and_exit_code_2(name: str, tmp_path: Path) -> None:
    content, told = BAD_FILES[name]
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    line = refused("fit", name, "--system", "phi4", "--library", "lib2", "--json", "out.json", cwd=tmp_path)
    assert name in line
    assert told in line
    assert not (tmp_path / "out.json").exists()


def test_a_pickled_npz_is_never_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, (f"touch {tmp_path / 'exploded'}",)

    np.savez(tmp_path / "bomb.npz", t=np.arange(3.0), u=np.array([Bomb(), 1, 2], dtype=object))
    line = refused("fit", "bomb.npz", "--system", "phi4", "--library", "lib2", cwd=tmp_path)
    assert "never loaded" in line
    assert not (tmp_path / "exploded").exists()


BAD_COMMANDS = {
    "fit phi4.csv --terms __import__('os').system('touch${IFS}pwned') --order 2": "column 1",
    "fit phi4.csv --terms ().__class__ --order 2": "not part of the term language",
    "fit phi4.csv --terms u[n+10**9] --order 2": "column 3",
    "fit phi4.csv --terms u**u**u**u --order 2": "u needs a site",
    "fit phi4.csv --terms u[n];u[n] --order 2": "twice",
    "fit phi4.csv --terms u[n]": "--order",
    "fit phi4.csv": "--terms",
    "fit phi4.csv --system phi4": "lib1",
    "fit phi4.csv --system phi4 --library lib9": "unknown library 'lib9'",
    "fit phi4.csv --system psi4 --library lib1": "did you mean 'phi4'",
    "fit phi4.csv --system phi4 --library lib1 --method stlqs": "did you mean 'stlsq'",
    "fit phi4.csv --system phi4 --library lib1 --set tresh=1 --method stlsq": "did you mean 'threshold'",
    "fit phi4.csv --system phi4 --library lib1 --set threshold=big --method stlsq": "threshold = 'big'",
    "fit phi4.csv --system phi4 --library lib1 --ends open": "--ends",
    "fit phi4.csv --system phi4 --library lib1 --method oracle": "needs the truth",
    "fit phi4.csv --terms f[n];u[n] --order 2": "no measured input",
    "fit phi4.csv dnls.parquet --system phi4 --library lib1": "real, the other complex",
    "fit phi4.csv --system phi4 --library lib1 --method sr3 --set regularizer=L7": "L7",
    "fit phi4.csv --system phi4 --library lib1 --set threshold=nan --method stlsq": "finite number",
    "fit phi4.csv --system phi4 --library lib1 --method three.py": "METHODS",
    "fit phi4.csv --system phi4 --library lib1 --method bare.py": "has no 'abilities'",
    "fit phi4.csv --system phi4 --library lib1 --method raising.py": "ZeroDivisionError: division by zero",
    "fit lab.csv --system phi4 --library lib1": '--time time_s --columns "x*"',
    "fit lab.csv --system phi4 --library lib1 --time zeit": "unknown column 'zeit'",
    "diagnose lab.csv --system phi4 --time time_s --columns y*": "unknown column 'y*'",
    "inspect lab.csv --time time_s --columns x* --scale furlong": "unknown scale 'furlong'",
    "inspect lab.csv --time time_s --columns x* --out x.bmp": "'.bmp'",
    "fit still.csv --terms u[n] --order 2 --method stlsq": "nothing moves",
    "fit large.csv --terms u[n]**12 --order 2": "not finite",
    "fit huge.csv --terms u[n] --order 2": "row 1, column u1: beyond 1e+50",
    "fit short.csv --terms u[n] --order 2 --method stlsq": "short.csv: a quintic spline needs at least 6 samples",
    "simulate phi4 --noise 1e308 --out x.csv": "noise",
    "fit nowhere.csv --system phi4 --library lib1": "nowhere.csv: no such file",
    "fit . --system phi4 --library lib1": "ending",
    "simulate phi4 --set C=two --out x.csv": "not a number",
    "simulate phi4 --set D=2 --out x.csv": "unknown parameter 'D'",
    "simulate phi4 --set v=1.5 --out x.csv": "below 1",
    "simulate phi4 --set C=-1 --out x.csv": "check the parameters",
    "simulate phi4 --set C=inf --out x.csv": "C",
    "simulate phi4 --samples 1 --out x.csv": "--samples",
    "simulate phi4 --missing 1 --out x.csv": "--missing",
    "simulate phi4 --initial knik --out x.csv": "did you mean 'kink'",
    "simulate phi4 --out x.xls": "ending",
    "simulate phi4 --out /dev/full/x.csv": "cannot be written",
    "run nothing": "unknown suite",
    "run bad.toml": "unknown key 'sistem'; did you mean 'system'",
    "run tiny --results phi4.csv": "a file, not a folder",
    "run tiny --only phi5*": "no case of this choice: only phi5*",
    "run tiny --methods stlqs": "--methods: unknown method 'stlqs'; did you mean 'stlsq'",
    "run tiny --methods gone.py": "gone.py: no such file",
    "run tiny --seeds 5-1": "--seeds 5-1",
    "run laboratory --methods stlsq": "there are no fits in it",
    "run tiny --dry-run --json": "leave one of the two out",
    "merge json --out new": "a store of version 2 or older",
    "run tiny --shard 0/3": "--shard 0/3: write K/N with K from 1 to N",
    "run tiny --shard 4/3": "--shard 4/3: write K/N",
    "run tiny --shard 10/12 --results new": "--shard 10/12: there is no case 10, the suite has 9",
    "run tiny --shard half": "--shard half: write K/N",
    "run tiny --results json": "a store of version 2 or older",
    "table json": "a store of version 2 or older",
    "table damaged": "results.sqlite: not a store of results that can be read",
    "table .": "not a store",
    "figures .": "not a store",
    "compare phi4.csv phi4.csv": "column 'identity' is missing",
    "compare json": "compare json with what?",
    "compare json json --against a": "give one run",
    "compare phi4.csv phi4.csv --out x.pdf": "go with --against",
    "compare phi4.csv --against a --out x.bmp": "unknown ending '.bmp'",
    "limit --system phi4": "--library",
    "limit --terms u[n] --order 2": "--system",
    "limit --system phi4 --library lib2 --noise 0": "must be a number above 0",
    "limit --system phi4 --library lib2 --target -1": "target",
    "limit --system phi4 --library lib2 --sites 0": "--sites",
    "limit --system phi4 --library lib2 --set D=2": "unknown parameter 'D'",
    "limit --system phi4 --library lib2 --initial knik": "did you mean 'kink'",
    "limit --system phi4 --terms u[n]": "outside the library",
    "limit --system phi4 --library lib2 --columns x*": "such as --time and --scale say how files are read",
    "limit --system phi4 --library lib2 --turn 360": "such as --time and --scale say how files are read",
    "limit phi4.csv --system phi4 --library lib2 --noise 0.1": "--noise: files are given",
    "limit phi4.csv --system phi4 --terms f[n]": "no measured input",
    "limit still.csv --terms u[n] --order 2": "still.csv: nothing moves",
    "limit huge.csv --terms u[n] --order 2": "huge.csv",
    "limit nowhere.csv --system phi4 --library lib1": "nowhere.csv: no such file",
    "table damaged --out x.tex": "tables go into a folder",
    "fit phi4.csv --system phi4 --library lib1 --html x.pdf": "--html x.pdf: it writes .html",
    "fit phi4.csv --system phi4 --library lib1 --json x.csv": "--json x.csv: it writes .json",
    "table . --only case": "unknown table 'case'; did you mean 'cases'",
    "lists systems": "No such command",
    "list system": "systems",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with samples of phi^4 and of the DNLS lattice, and with what nobody can use."""
    place = tmp_path_factory.mktemp("bad")
    succeed("simulate", "phi4", "--noise", 0.001, "--out", "phi4.csv", cwd=place)
    succeed("simulate", "dnls", "--out", "dnls.parquet", cwd=place)
    (place / "three.py").write_text("METHODS = (3,)\n")
    (place / "bare.py").write_text("class Bare:\n    name = 'bare'\n\nMETHODS = (Bare,)\n")
    (place / "raising.py").write_text(
        "from latticebench.methods.method import Abilities\n\n"
        "class Raising:\n    name = 'raising'\n    abilities = Abilities()\n\n"
        "    def fit(self, data, library, order, seed):\n        return 1 / 0\n\nMETHODS = (Raising,)\n"
    )
    (place / "lab.csv").write_text("time_s;x1;x2\n0;1;2\n1;2;3\n")
    (place / "still.csv").write_text("t,u1\n" + "".join(f"{k},3.5\n" for k in range(20)))
    for name, size in (("large", 1e40), ("huge", 1e200)):
        (place / f"{name}.csv").write_text("t,u1\n" + "".join(f"{k},{(-1) ** k * size}\n" for k in range(20)))
    (place / "short.csv").write_text("t,u1\n" + "".join(f"{k},{k * k}\n" for k in range(4)))
    (place / "bad.toml").write_text('[methods.a]\nmethod = "zero"\n[[grid]]\nsistem = "phi4"\nlibraries = ["lib1"]\n')
    for name, file, content in (("json", "store.json", '{"version": 2}'), ("damaged", "results.sqlite", "x" * 5000)):
        (place / name).mkdir()
        (place / name / file).write_text(content)
    return place


@pytest.mark.parametrize("command", BAD_COMMANDS)
def test_bad_input_is_one_clear_line_and_exit_code_2(command: str, folder: Path) -> None:
    with unchanged(folder):
        assert BAD_COMMANDS[command] in refused(*command.split(), cwd=folder)


@pytest.mark.parametrize(
    "options", [("--terms", "x" * 9000), ("--method", "m" * 9000), ("--method", "m" * 9000 + ".py")]
)
def test_a_name_of_any_length_is_refused_in_a_line_that_can_be_read(options: tuple[str, str], tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("t,u1\n0,1\n1,2\n2,3\n")
    told = refused(
        "fit", "r.csv", "--order", "2", *("--terms", "u[n]")[: 2 * (options[0] != "--terms")], *options, cwd=tmp_path
    )
    assert len(told) < 2100
