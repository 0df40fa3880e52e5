"""What all tests share: one thread, the seeds of attacks, and the scripts in results/ as modules."""

import gc
import importlib.util
import os
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest import mock

import hypothesis
import pytest

from commandline import Seeds
from latticebench.bench import cgroup

# Two threads on two busy cores are many times slower than one.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# Seeds of one number of `--fresh`.
APART = 1_000_000
# Examples of a hypothesis test that sets no number of its own, with fresh seeds; 100 otherwise.
FRESH_EXAMPLES = 500
RESULTS = Path(__file__).parents[1] / "results"


def pytest_addoption(parser: pytest.Parser) -> None:
    told = "attack with seeds that are N times a million larger; --hypothesis-seed N draws texts anew, too"
    parser.addoption("--fresh", type=int, default=0, metavar="N", help=told)


def pytest_configure(config: pytest.Config) -> None:
    hypothesis.settings.register_profile("repeated", derandomize=True)
    hypothesis.settings.register_profile("fresh", database=None, max_examples=FRESH_EXAMPLES)
    hypothesis.settings.load_profile("fresh" if config.getoption("--fresh") else "repeated")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--fresh"):
        left_out = [item for item in items if item.get_closest_marker("fresh")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def pytest_collection_finish() -> None:
    # What the tests have imported stays: looking at it again and again takes a twentieth of their time.
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session")
def seeds(pytestconfig: pytest.Config) -> Seeds:
    """Return a function that gives the seeds of attacks."""
    moved = APART * pytestconfig.getoption("--fresh")
    return lambda first, end: range(moved + first, moved + end)


@pytest.fixture(scope="session")
def script() -> Callable[[str], ModuleType]:
    """Return a function that imports a script by its path below results/."""

    def load(path: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"results_{Path(path).stem}", RESULTS / path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        # Dataclasses look up their module by its name.
        sys.modules[spec.name] = module
        # Some scripts set the number of threads.
        with mock.patch.dict(os.environ):
            spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def groups() -> bool:
    """Whether control groups can be made here."""
    mark = uuid.uuid4().hex
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE) as trial:
        cgroup.enter(trial.pid, mark)
        found = cgroup.members(mark) == [trial.pid]
    cgroup.end(mark)
    return found
