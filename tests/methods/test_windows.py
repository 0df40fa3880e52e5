"""Long chains by windows whose outer sites move as they were read."""

from __future__ import annotations

import functools
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods import trajectory
from latticebench.methods.engine.windows import cut
from latticebench.methods.method import Abilities, obstacle, solve
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate
from latticebench.systems.stencil import Ends

TRUTH = np.array([2.0, 2.0, -2.0, -2.0])


@functools.cache
def chain(ends: Ends = "free", sites: int = 132) -> Samples:
    clean = simulate(
        systems.find("phi4"), sites=sites, times=sample_times(40, 4.0), ends=ends, variation=np.random.default_rng(4)
    )
    return replace(observe(clean, np.random.default_rng(1), noise=0.01).observed(), ends=ends)


@pytest.mark.parametrize("ends", ["free", "periodic", "unknown"])
def test_every_site_belongs_to_one_window_and_is_read_around_it(ends: Ends) -> None:
    samples = replace(chain(), ends=ends)
    parts = list(cut(samples, (1, 2), 30))
    np.testing.assert_array_equal(np.concatenate([part.sites for part in parts]), np.arange(132))
    for part in parts:
        np.testing.assert_array_equal(part.samples.u[:, part.own], samples.u[:, part.sites])
    inner = parts[1]
    assert inner.samples.sites == len(inner.sites) + 3
    assert parts[0].samples.sites == len(parts[0].sites) + (3 if ends == "periodic" else 2)


@pytest.mark.parametrize("ends", ["free", "periodic"])
def test_windows_find_what_the_whole_chain_tells(monkeypatch: pytest.MonkeyPatch, ends: Ends) -> None:
    terms = systems.find("phi4").library("lib2")
    whole = Trajectory().fit([chain(ends)], terms, 2, seed=1)
    monkeypatch.setattr(trajectory, "WIDE", 66)
    found = Trajectory().fit([chain(ends)], terms, 2, seed=1)
    assert found.found["windows"] == 2.0
    assert found.status == "ok"
    assert whole.stderr is not None
    assert found.stderr is not None
    # Two windows know less than the chain, most where much moves at their border, and say so.
    assert np.all((found.stderr > 0.95 * whole.stderr) & (found.stderr < 1.5 * whole.stderr))
    assert np.all(np.abs(found.coefficients - whole.coefficients) < 1.5 * whole.stderr)
    assert np.all(np.abs(found.coefficients - TRUTH) < 4 * found.stderr)
    assert float(found.found["noise_u"]) == pytest.approx(float(whole.found["noise_u"]), rel=0.05)
    assert found.motion is not None
    assert whole.motion is not None
    left = np.std(found.motion[0].u - whole.motion[0].u)
    assert left < float(whole.found["noise_u"])


def test_terms_are_selected_by_all_windows_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "WIDE", 66)
    found = Trajectory(select=True).fit([chain()], systems.find("phi4").library("lib3"), 2, seed=1)
    np.testing.assert_allclose(found.coefficients[:4], TRUTH, atol=0.01)
    assert not np.any(found.coefficients[4:])


def test_terms_that_ask_for_the_number_of_a_site_are_fitted_to_the_whole_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "WIDE", 16)
    few = replace(chain(sites=20), ends="free")
    found = Trajectory().fit([few], library("own", "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3; n*u[n]"), 2, seed=1)
    assert "windows" not in found.found
    assert abs(found.coefficients[3]) < 0.01


def test_what_a_method_takes_at_once_is_a_window_unless_a_term_has_n() -> None:
    able = Abilities(memory=1e8, window=10)
    data = [chain()]
    assert not obstacle(replace(able, memory=1.0), data, library("own", "u[n]"))
    narrow = obstacle(replace(able, memory=1e10), data, library("own", "u[n]"))
    whole = obstacle(replace(able, memory=1e10), data, library("own", "n*u[n]"))
    assert "for 400 values" in narrow
    assert "for 5280 values" in whole


def test_a_fit_takes_no_more_memory_than_its_method_declares() -> None:
    method, terms, samples = Trajectory(), systems.find("phi4").library("lib2"), chain(sites=40)
    solve(method, [replace(samples, u=samples.u[:, :12], v=None)], terms, 2, 1)
    tracemalloc.start()
    try:
        solve(method, [samples], terms, 2, 1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    declared = method.abilities.memory * samples.u.size * len(terms.terms)
    assert declared / 20 < peak < declared
