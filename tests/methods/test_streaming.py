"""Methods that go through a chain some sites at a time: the coefficients are those of the whole chain at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.methods import weak_stlsq
from latticebench.methods.engine import integrated_equation, regression
from latticebench.methods.method import make, solve
from latticebench.systems.lattice import library
from latticebench.systems.simulate import observe, sample_times, simulate

STREAMING = ("least-squares", "stlsq", "sr3", "sindy-tuned", "weak-stlsq")
NEARLY_DEPENDENT = library("near", "u[n+1]; u[n-1]; u[n]; u[n]**3; sin(u[n])")


@pytest.mark.parametrize("name", STREAMING)
@pytest.mark.parametrize("case", ["real", "complex", "ill-conditioned"])
def test_windows_of_a_chain_give_the_coefficients_of_the_whole(
    monkeypatch: pytest.MonkeyPatch, name: str, case: str
) -> None:
    system = systems.find("dnls" if case == "complex" else "sine-gordon")
    clean = simulate(system, sites=60, times=sample_times(60, 5.0))
    samples = replace(observe(clean, np.random.default_rng(1), noise=0.001).observed(), ends=system.ends)
    terms = system.library("equation") if case != "ill-conditioned" else NEARLY_DEPENDENT
    if case == "ill-conditioned":
        # A motion this small hardly tells the sine from u - u^3/6.
        samples = replace(samples, u=0.07 * samples.u, v=0.07 * samples.v)  # type: ignore[operator]
    method = make(methods.find(name), {})
    whole = solve(method, [samples], terms, system.order, 1)
    for module in (regression, integrated_equation, weak_stlsq):
        monkeypatch.setattr(module, "PIECE", 9000)
    parts = solve(method, [samples], terms, system.order, 1)
    assert np.any(whole.coefficients)
    assert np.max(np.abs(parts.coefficients - whole.coefficients)) <= 1e-9 * np.max(np.abs(whole.coefficients))
    assert parts.residual == pytest.approx(whole.residual, rel=1e-8)


def test_the_rows_of_the_ill_conditioned_case_have_a_conditioning_of_a_million() -> None:
    system = systems.find("sine-gordon")
    clean = simulate(system, sites=60, times=sample_times(60, 5.0))
    assert clean.v is not None
    samples = replace(clean.observed(), u=0.07 * clean.u, v=0.07 * clean.v, ends=system.ends)
    design = regression.rows([samples], NEARLY_DEPENDENT, 2, "smoothing-spline").design
    assert 8e5 < np.linalg.cond(design / np.linalg.norm(design, axis=0)) < 1e9
