"""What all tests share: one thread, and the scripts in results/ as modules."""

import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest import mock

import pytest

# Two threads on two busy cores are many times slower than one.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

RESULTS = Path(__file__).parents[1] / "results"


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
