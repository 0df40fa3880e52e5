"""Methods that misbehave side by side with a good one: each is a row with its reason, and nothing of them is left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from latticebench.bench.guardian import Guardian
from latticebench.bench.run import run
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.systems.errors import InputError
from latticebench.systems.user_files import load_module, raised

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and looks at processes")

METHOD = """
import ctypes, os, signal, subprocess, sys, time
from dataclasses import dataclass, replace
from typing import ClassVar
import numpy as np
from latticebench.methods.method import Abilities, Fit

MARKER = {marker!r}
def sleeper(eats=0, **options):
    program = f"import time; x = b'1' * {{eats}}; time.sleep(3600)"
    return subprocess.Popen([sys.executable, "-c", program, MARKER], **options)

{before}

@dataclass(frozen=True)
class Own:
    name: ClassVar[str] = "own"

    @property
    def abilities(self):
        return Abilities()

    def fit(self, data, library, order, seed):
        one = Fit(self.name, library, order, np.ones(len(library.terms)), 0.5)
{within}
        return one

METHODS = (Own,)
"""
# What a method does when it is imported, what it does in its fit, the status of its row, and a part of its reason.
DEEDS: dict[str, tuple[str, str, str, str]] = {
    "prints when imported": ("print('{not json'); os.write(1, b'from below')", "", "ok", "from below"),
    "hangs when imported": ("time.sleep(3600)", "", "timeout", "time limit of 2 s"),
    "ends when imported": ("os._exit(0)", "", "died", "exit code 0"),
    "exits when imported": ("sys.exit('enough')", "", "failed", "SystemExit"),
    "is no Python": ("def", "", "failed", "SyntaxError"),
    "lists nothing": ("", "pass\nMETHODS = ()\ndel METHODS\ndef nothing():", "failed", "it must define METHODS"),
    "complex": ("", "return replace(one, coefficients=one.coefficients + 1j)", "failed", "must be real"),
    "infinite": ("", "return replace(one, coefficients=one.coefficients * np.inf)", "failed", "not finite"),
    "too many": ("", "return replace(one, coefficients=np.ones(1000))", "failed", "shape (1000,)"),
    "texts": ("", "return replace(one, coefficients=np.array(['1'] * len(library.terms)))", "failed", "real numbers"),
    "a list": ("", "return replace(one, coefficients=[1.0] * len(library.terms))", "failed", "NumPy array"),
    "no fit": ("", "return {'coefficients': 1}", "failed", "it must return a Fit"),
    "talks": ("", "return replace(one, status='x' * 10**8)", "failed", "at most 2000 characters"),
    "objects": ("", "return replace(one, found={'a': object()})", "failed", "numbers and texts"),
    "surrogates": ("", "return replace(one, status='\\ud800')", "ok", ""),
    "other library": ("", "return replace(one, library=type(library)('x', library.terms[::-1]))", "failed", "another"),
    "raises Ctrl-C": ("", "raise KeyboardInterrupt", "failed", "KeyboardInterrupt"),
    "says nothing": (
        "class Mute(Exception):\n    def __str__(self): raise Mute", "raise Mute", "failed", "Mute: it says nothing",
    ),
    "leaves a child": ("", "sleeper()", "ok", ""),
    "leaves a session": ("", "sleeper(start_new_session=True)\nos.kill(os.getpid(), 9)", "died", "SIGKILL"),
    "leaves an orphan": (
        "",
        "if not os.fork():\n    os.setsid()\n    sleeper(env={{}})\n    os._exit(0)\ntime.sleep(3600)",
        "timeout", "time limit",
    ),
    "hides": ("", "sleeper(start_new_session=True, env={{}})\nos.kill(os.getpid(), 9)", "died", "SIGKILL"),
    "hides from both": (
        "",
        "sleeper(start_new_session=True, env={{}})\nos.kill(os.getppid(), 9)\nos.kill(os.getpid(), 9)",
        "died", "SIGKILL",
    ),
    "kills its parent": ("", "os.kill(os.getppid(), 9)\ntime.sleep(3600)", "died", "SIGKILL"),
    "kills its group": ("", "os.killpg(0, 9)", "died", "SIGKILL"),
    "interrupts its parent": ("", "os.kill(os.getppid(), 2)\ntime.sleep(3600)", "died", "itself (SIGINT)"),
    "stops its parent and ends": ("", "os.kill(os.getppid(), signal.SIGSTOP)\nos._exit(3)", "died", "exit code 3"),
    "floods the answers": (
        "",
        "while True:\n    for k in range(3, 9):\n        try: os.write(k, b'{{\"done\":0}}\\n' * 5000)\n"
        "        except OSError: pass",
        "failed", "no result",
    ),
    "stops its parent": ("", "os.kill(os.getppid(), signal.SIGSTOP)", "ok", ""),
    "children eat": (
        "", "many = [sleeper(eats=2**29) for _ in range(2)]\nmany[0].wait()", "memory", "900 MiB",
    ),
    "copies itself": ("", "os.fork()", "ok", ""),
    "floods": ("", "while True: print('flood' * 1000)", "timeout", "flood"),
    "closes all": ("", "os.closerange(3, 1000)", "died", "ended by itself"),
    "answers itself": (
        "", "for k in range(3, 9):\n    try: os.write(k, b'7\\n')\n    except OSError: pass", "failed", "no result",
    ),
    "crashes": ("", "ctypes.string_at(1)", "died", "SIGSEGV"),
    "reads": ("", "input()", "failed", "EOFError"),
    "asks for a thread": ("", "import threading\nthreading.Thread(target=time.sleep, args=(3600,)).start()", "ok", ""),
}  # fmt: skip


# Each starts a worker of its own; the others are of the same kinds, or in `test_run.py`, where one does for several.
QUICK = (
    "prints when imported", "leaves a session", "leaves an orphan", "hides", "kills its parent",
    "stops its parent and ends", "children eat", "floods", "answers itself", "floods the answers",
)  # fmt: skip


def write_suite(folder: Path, marker: str, deeds: Sequence[str]) -> Path:
    """Write each method to a file of its own, and a suite of them with a good one between every two."""
    text = '[methods.good]\nmethod = "zero"\n[defaults]\nsystem = "phi4"\nsites = 5\nsamples = 8\nspan = 1.0\n'
    text += 'libraries = ["lib1"]\ntime_limit = 3600\nmemory_limit = 900\n'
    for number, name in enumerate(deeds):
        before, within, status, _ = DEEDS[name]
        body = METHOD.format(
            marker=marker, before=before, within=textwrap.indent(within.replace("{{}}", "{}"), " " * 8)
        )
        if name == "lists nothing":
            body = "pass\n"
        (folder / f"m{number}.py").write_text(body)
        text += f'[methods."{name}"]\nmethod = "m{number}.py"\n'
        limit = f"time_limit = {5 if name == 'floods' else 2}\n" * (status == "timeout")
        text += (
            f'[[grid]]\n{limit}methods = ["{name}"]\n[[grid]]\nmethods = ["good"]\nseeds = [{number}]\nnoise = 0.01\n'
        )
    (folder / "hostile.toml").write_text(text)
    return folder / "hostile.toml"


def alive(marker: str) -> list[str]:
    every = [one.info for one in psutil.process_iter(["cmdline", "status"])]
    return [
        " ".join(one["cmdline"])
        for one in every
        if marker in (one["cmdline"] or ()) and one["status"] != psutil.STATUS_ZOMBIE
    ]


def every_one_is_a_row(folder: Path, deeds: Sequence[str], groups: bool) -> None:
    marker = f"marker-{os.getpid()}-{time.monotonic_ns()}"
    if not groups:
        # Without a group nothing finds what hides when its worker and the process above that are dead.
        deeds = [name for name in deeds if name != "hides from both"]
    results, _ = run(load(str(write_suite(folder, marker, deeds))), create(folder / "store"), jobs=2)
    found = {(one["case"]["label"], one["case"]["seed"]): one for one in results}
    assert [found["good", number]["status"] for number in range(len(deeds))] == ["ok"] * len(deeds)
    told = {name: (found[name, 1]["status"], found[name, 1]["reason"]) for name in deeds}
    assert not {name: row for name, row in told.items() if row[0] != DEEDS[name][2] or DEEDS[name][3] not in row[1]}
    assert alive(marker) == []


def test_every_hostile_method_is_a_row_with_its_reason_and_nothing_of_it_is_left(
    tmp_path: Path, capfd: Any, groups: bool
) -> None:
    every_one_is_a_row(tmp_path, QUICK, groups)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_hostile_methods_of_many_more_kinds_are_rows_and_leave_nothing(tmp_path: Path, groups: bool) -> None:
    every_one_is_a_row(tmp_path, list(DEEDS), groups)


def test_what_ends_behind_a_case_is_not_left_as_a_zombie(tmp_path: Path) -> None:
    count = "print('zombies', sum(one.status() == 'zombie' for one in psutil.Process().children()))"
    left = "subprocess.run(['sh', '-c', 'true & true & true'])\ntime.sleep(0.2)"
    body = METHOD.format(marker="none", before="import psutil", within=textwrap.indent(f"{count}\n{left}", " " * 8))
    (tmp_path / "m.py").write_text(body)
    text = '[methods.a]\nmethod = "m.py"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\nseeds = [1, 2, 3]\n'
    (tmp_path / "s.toml").write_text(text + "noise = 0.01\nsites = 5\nsamples = 8\nspan = 1.0\n")
    results, _ = run(load(str(tmp_path / "s.toml")), create(tmp_path / "store"), jobs=1)
    assert [(one["status"], one["reason"]) for one in results] == [("ok", "printed: zombies 0")] * 3


def test_a_guardian_that_was_stopped_does_not_hold_up_the_end() -> None:
    with Guardian() as guardian:
        guardian.process.send_signal(signal.SIGSTOP)
    assert guardian.process.poll() == 0


def test_a_killed_run_leaves_no_process_of_a_method_behind(tmp_path: Path) -> None:
    """Neither one in a session of its own, nor a worker that holds the interpreter's lock."""
    marker = f"marker-{os.getpid()}-{time.monotonic_ns()}"
    gate = f"open({str(tmp_path / 'gate')!r}, 'w').close()"
    held = f"sleeper(start_new_session=True)\n{gate}\nctypes.PyDLL(None).sleep(9999)"
    body = METHOD.format(marker=marker, before="", within=textwrap.indent(held, " " * 8))
    (tmp_path / "m.py").write_text(body)
    (tmp_path / "s.toml").write_text('[methods.a]\nmethod = "m.py"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n')
    options = ["run", "s.toml", "--jobs", "1"]
    with subprocess.Popen([sys.executable, "-m", "latticebench", *options], cwd=tmp_path) as runner:
        wait_for(lambda: (tmp_path / "gate").exists())
        workers = psutil.Process(runner.pid).children(recursive=True)
        assert alive(marker)
        runner.kill()
    wait_for(lambda: not alive(marker) and not any(one.is_running() for one in workers))


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


MARKER = f"fitted-{os.getpid()}"


def fitted(folder: Path, deed: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Fit by a method that does a deed, within limits."""
    before, within, *_ = DEEDS[deed]
    body = METHOD.format(marker=MARKER, before=before, within=textwrap.indent(within, " " * 8))
    (folder / "m.py").write_text(body)
    (folder / "t.csv").write_text("t,u1,u2,u3\n" + "".join(f"{k},{k % 3},{k % 4},{k % 5}\n" for k in range(12)))
    command = [
        sys.executable, "-m", "latticebench", "fit", "t.csv", "--terms", "u[n]", "--order", "2", "--ends", "free",
        "--method", "m.py", "--json", "r.json", *options,
    ]  # fmt: skip
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


def test_a_method_that_prints_is_fitted_and_its_output_shown_apart(tmp_path: Path) -> None:
    done = fitted(tmp_path, "prints when imported")
    assert done.returncode == 0, done.stderr
    assert "from below" in done.stderr
    assert "from below" not in done.stdout
    assert (tmp_path / "r.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("deed", ["ends when imported", "hangs when imported", "children eat", "complex", "crashes"])
def test_a_hostile_method_that_is_fitted_is_one_line_with_the_reason(deed: str, tmp_path: Path) -> None:
    seconds = "2" if DEEDS[deed][2] == "timeout" else "3600"
    done = fitted(tmp_path, deed, "--time-limit", seconds, "--memory-limit", "900")
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f"error: method 'm.py': {DEEDS[deed][2]}: ")
    assert DEEDS[deed][3] in line
    assert not (tmp_path / "r.json").exists()
    assert alive(MARKER) == []


def test_what_a_method_raises_is_told_with_its_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "m.py").write_text("def deep():\n    return [].foo\n\n\nMETHODS = (deep(),)\n")
    with pytest.raises(InputError, match=r"AttributeError: 'list' object has no attribute 'foo' \(m\.py, line 2\)"):
        load_module(tmp_path / "m.py")
    assert raised(ValueError("elsewhere")) == "ValueError: elsewhere"


def test_a_suite_names_a_method_file_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        '[methods.a]\nmethod = "gone.py"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n'
    )
    with pytest.raises(InputError, match=r"methods\.a: .*gone\.py: no such file"):
        load(str(tmp_path / "s.toml"))


def test_nothing_is_imported_from_the_working_folder(tmp_path: Path) -> None:
    for name in ("psutil", "numpy", "json", "pickle"):
        (tmp_path / f"{name}.py").write_text(f"open('ran', 'w')\nraise RuntimeError({name!r})\n")
    (tmp_path / "s.toml").write_text(
        '[methods.a]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\nsites = 5\nsamples = 8\nspan = 1.0\n'
        'libraries = ["lib1"]\n'
    )
    program = "import sys; sys.path.remove(''); from latticebench.bench.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "run", "s.toml", "--jobs", "1"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "1 cases (1 ok)" in done.stdout
    assert not (tmp_path / "ran").exists()
