from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.trials import specimen
from latticebench.diagnosis.model import Model
from latticebench.methods.method import Smooth


@pytest.fixture(scope="module")
def residuals(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("loop/residuals.py")


@pytest.mark.parametrize("name", ["trajectory", "weak", "splines"])
def test_every_residual_names_a_force_that_is_plain_to_see(residuals: ModuleType, name: str) -> None:
    system = systems.find("phi4")
    one = specimen.make(system, "damping", 100.0, np.random.default_rng(3), specimen.Conditions(variation=True))
    samples = replace(one.samples.observed(), ends=system.ends)
    tangent = residuals.METHODS[name](Model(system.library("equation"), system.order), samples)
    # The declared terms have been projected out.
    assert np.max(np.abs(tangent.known.T @ tangent.residual)) < 1e-6 * np.linalg.norm(tangent.residual)
    assert residuals.findings(tangent)[0].name == "damping"


def test_weak_rows_are_white_where_nothing_is_missing(residuals: ModuleType) -> None:
    system = systems.find("phi4")
    one = specimen.make(system, "none", 0.0, np.random.default_rng(3), specimen.Conditions(variation=True))
    samples = replace(one.samples.observed(), ends=system.ends)
    tangent = residuals.by_weak(Model(system.library("equation"), system.order), samples)
    assert np.sum(tangent.residual**2) / tangent.spare == pytest.approx(1, abs=0.2)


def test_about_as_many_stretches_are_taken_as_a_residual_has_independent_values(residuals: ModuleType) -> None:
    draw = np.random.default_rng(0)
    count, memory = 2000, 20.0
    series = np.zeros((count, 1, 40))
    keep = np.exp(-1 / memory)
    for k in range(1, count):
        series[k] = keep * series[k - 1] + draw.normal(size=(1, 40))
    curves = Smooth(np.arange(count) * 1.0, np.full(count, 1 / count), np.stack([series, series]))
    project = residuals.stretches(series, curves)
    rows = project(series[None]).shape[0] / 40 + 2
    # An autoregression forgets in (1 + keep) / (1 - keep) steps.
    assert rows == pytest.approx(count * (1 - keep) / (1 + keep), rel=0.2)
    # The mean over a stretch of a constant is the constant.
    np.testing.assert_allclose(project(np.ones((1, count, 1, 40))), 1.0, rtol=0.05)
