"""Anything that goes on from sample to sample or from site to site is seen, whatever its form; noise is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis.coherence import coherence, farthest
from latticebench.diagnosis.model import Model, first_fit
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import surrogate_residuals
from latticebench.systems.effects import find


def tangent_of(name, missing=0.0):
    system = systems.find(name)
    one = make(system, "none", 0.0, np.random.default_rng(4), Conditions(sites=9, samples=40, span=8.0, variation=True))
    samples = one.samples.observed()
    u = np.where(np.random.default_rng(0).uniform(size=samples.u.shape) < missing, np.nan, samples.u)
    data = [replace(samples, u=u, ends=system.ends)]
    return linearise(first_fit(Model(system.library("equation"), system.order), data))


@pytest.mark.parametrize(("name", "missing"), [("phi4", 0.0), ("dnls", 0.1)])
def test_noise_is_called_rare_no_more_often_than_it_is(name, missing):
    tangent = tangent_of(name, missing)
    draws = surrogate_residuals(tangent, np.random.default_rng(1), 120).T
    p = [coherence(replace(tangent, residual=one), np.random.default_rng(2)).p for one in draws]
    assert all(np.mean(np.array(p) < level) <= 1.5 * level + 0.01 for level in (0.02, 0.1, 0.3, 0.5))
    assert min(p) > 1e-4
    assert np.mean(np.array(p) < 0.5) > 0.1


@pytest.mark.parametrize(
    ("shape", "name"),
    [
        (lambda x, _n, _rng: np.sin(40 * x**2 + 1) + 0 * _n, "time and along"),
        (lambda x, n, rng: rng.normal(size=n.shape[1]) * np.sin(25 * x), "in time"),
        (lambda x, n, rng: rng.normal(size=len(x))[:, None] * np.cos(n / 3), "along the chain"),
    ],
)
def test_what_has_no_form_in_any_list_is_seen(shape, name):
    tangent = tangent_of("sine-gordon")
    path = tangent.paths[0]
    n = np.arange(9.0)[None]
    wrong = np.zeros(path.weight.shape)
    wrong[:, 0, 0] = shape(np.linspace(0, 1, len(wrong))[:, None], n, np.random.default_rng(3))
    column = tangent.new(path.free(path.rows(wrong[None])))[:, 0]
    noise = surrogate_residuals(tangent, np.random.default_rng(5), 1)[:, 0]
    found = coherence(replace(tangent, residual=noise + 20 * column / np.linalg.norm(column)), np.random.default_rng(6))
    assert found.p < 1e-6
    assert name in found.name


@pytest.mark.parametrize(("name", "missing"), [("phi4", 0.0), ("dnls", 0.1)])
def test_a_reading_far_out_is_seen_at_its_site_and_those_of_noise_are_not(name, missing):
    tangent = tangent_of(name, missing)
    draws = surrogate_residuals(tangent, np.random.default_rng(1), 400).T
    p = np.array([farthest(replace(tangent, residual=one)).p for one in draws])
    assert all(np.mean(p < level) <= 1.5 * level + 0.01 for level in (0.02, 0.1, 0.3))
    assert np.mean(p < 0.5) > 0.1
    path = tangent.paths[0]
    row = int(np.flatnonzero(path.weight[12, 0, 0] > 0)[3])
    far = np.zeros(path.weight.shape)
    far[12, 0, 0, row] = 8 / path.weight[12, 0, 0, row]
    spike = tangent.new(path.free(path.rows(far[None])))[:, 0]
    found = farthest(replace(tangent, residual=draws[0] + spike))
    assert found.p < 1e-4
    assert found.placed.site == row


def test_an_effect_that_no_term_comes_near_is_unexplained_all_the_same(monkeypatch):
    """With nothing to compare with but one effect that is not there."""
    monkeypatch.setattr("latticebench.diagnosis.trace.unnamed", lambda _: [])
    monkeypatch.setattr("latticebench.diagnosis.trace.misreadings", lambda _: [])
    system = systems.find("sine-gordon")
    verdicts = []
    for effect, z in (("none", 0.0), ("other: noise-force", 40.0)):
        one = make(
            system, effect, z, np.random.default_rng(8), Conditions(sites=9, samples=40, span=8.0, variation=True)
        )
        data = [replace(one.samples.observed(), ends=system.ends)]
        found = diagnose(system.library("equation"), 2, data, [find("dry-friction")])
        verdicts.append(found.course.verdict)
    assert verdicts == ["nothing missing", "unexplained"]
