"""Run times of methods and integrators, which `make speed` prints side by side and as multiples of the fastest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.bench.limit import bound_of
from latticebench.methods.method import make, solve
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, simulate

# The networks take seconds per fit, and a method that is shown the truth is no contestant.
METHODS = [
    name
    for name, kind in sorted(methods.registered().items())
    if not (kind().abilities.truth or kind().abilities.missing_packages or name.startswith("pinn"))
]


@pytest.fixture(scope="module")
def samples() -> Samples:
    clean = simulate(systems.find("phi4"), integrator="dop853")
    return observe(clean, np.random.default_rng(1), noise=0.01).observed()


@pytest.mark.benchmark(group="one fit of four terms, 31 sites, 50 samples")
@pytest.mark.parametrize("name", METHODS)
def test_a_fit_is_timed(benchmark: Any, name: str, samples: Samples) -> None:
    method, library = make(methods.find(name), {}), systems.find("phi4").library("lib2")
    # The first call, which fills caches, does not count.
    fit = benchmark.pedantic(solve, args=(method, [samples], library, 2, 1), rounds=5, iterations=1, warmup_rounds=1)
    assert np.all(np.isfinite(fit.coefficients))


@pytest.mark.benchmark(group="one simulation of ten units of time, 31 sites")
@pytest.mark.parametrize("integrator", ["rk4", "bdf", "dop853"])
def test_an_integrator_is_timed(benchmark: Any, integrator: Any) -> None:
    found = benchmark.pedantic(simulate, args=(systems.find("phi4"),), kwargs={"integrator": integrator}, rounds=3)
    assert np.all(np.isfinite(found.u))


@pytest.mark.benchmark(group="the bound of four terms, 31 sites, 50 samples")
def test_the_bound_is_timed(benchmark: Any) -> None:
    library = systems.find("phi4").library("lib2")
    truth = simulate(systems.find("phi4"), integrator="dop853")
    found = benchmark.pedantic(bound_of, args=([truth], library, 2), kwargs={"noise": 0.01}, rounds=3)
    assert np.all(np.isfinite(found.stderr))
