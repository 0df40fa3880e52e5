"""What an instrument may do without a name: each is found as what it is, and goes with the velocities as it should."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis import misreadings
from latticebench.diagnosis.model import Model, first_fit
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import screen
from latticebench.systems.effects import CATALOGUE


@functools.cache
def tangent_of(name):
    system = systems.find(name)
    one = make(system, "none", 0.0, np.random.default_rng(4), Conditions(sites=9, samples=30, span=6.0, variation=True))
    data = [replace(one.samples.observed(), ends=system.ends)]
    return linearise(first_fit(Model(system.library("equation"), system.order), data))


def clipped(u, _rate):
    limit = 0.8 * np.max(np.abs(u))
    return np.clip(u, -limit, limit) - u, 0 * u


def mixed(u, rate):
    beside = np.eye(u.shape[-1], k=1) + 0.5 * np.eye(u.shape[-1], k=-1)
    return u @ beside, rate @ beside


def late(u, rate):
    return rate * np.eye(u.shape[-1])[3], 0 * u


def drifting(u, _rate):
    course = np.linspace(-1, 1, len(u))[:, None, None] ** 3
    return course * np.eye(u.shape[-1])[3] * np.ones_like(u), 0 * u


def sticking(_u, rate):
    return np.sign(rate), 0 * rate


def humming(u, _rate):
    wave = np.cos(2.3 * np.linspace(0, 6, len(u)) + 0.7)
    return wave[:, None, None] * np.ones_like(u), 0 * u


def flickering(u, rate):
    bright = np.random.default_rng(7).normal(size=len(u))[:, None, None]
    return bright * u, bright * rate


def lifted(u, _rate):
    return np.random.default_rng(7).normal(size=len(u))[:, None, None] * np.ones_like(u), 0 * u


def scanned(u, rate):
    return rate * np.arange(u.shape[-1]), 0 * u


def tilted(u, rate):
    slant = np.linspace(-1, 1, u.shape[-1])
    return slant * u, slant * rate


def heaved(u, _rate):
    return np.linspace(-1, 1, u.shape[-1]) ** 2 * np.ones_like(u), 0 * u


@pytest.mark.parametrize("name", ["phi4", "ginzburg-landau"])
@pytest.mark.parametrize(
    ("error", "found", "site"),
    [
        (sticking, "readings wrong by a function of the rate", None),
        (humming, "a hum in all readings", None),
        (flickering, "readings scaled at each time by its own", None),
        (lifted, "readings lifted at each time by its own", None),
        (scanned, "readings late, each site's by its own", None),
        (tilted, "readings scaled by a smooth course along the chain", None),
        (heaved, "readings lifted by a smooth course along the chain", None),
        (clipped, "readings wrong by a function of the field", None),
        (mixed, "readings mixed with the neighbours'", None),
        (late, "one site's readings late", 3),
        (drifting, "readings of u at one site wrong by any course", 3),
    ],
)
def test_an_error_of_an_instrument_is_found_as_what_it_is(name, error, found, site):
    tangent = tangent_of(name)
    path = tangent.paths[0]
    field = path.field[:: path.steps]
    rate = np.gradient(path.field[:, 0], path.times, axis=0)[:: path.steps]
    wrong = np.stack(error(field[:, 0], rate)[: path.weight.shape[1]], axis=1)
    column = tangent.new(path.free(path.rows(wrong[None])))[:, 0]
    faulty = replace(tangent, residual=tangent.residual + 30 * column / np.linalg.norm(column))
    first = screen(faulty, CATALOGUE, np.random.default_rng(0), 40)[0]
    assert first.name == found
    assert first.placed.site == site


def test_sensors_that_are_each_a_little_off_follow_no_smooth_course():
    """Scales of 25 sensors without a pattern are the sensors' own, and those of a slant are not."""
    system = systems.find("phi4")
    one = make(system, "none", 0.0, np.random.default_rng(4), Conditions(variation=True))
    data = [replace(one.samples.observed(), ends=system.ends)]
    tangent = linearise(first_fit(Model(system.library("equation"), system.order), data))
    path = tangent.paths[0]
    field = path.field[:: path.steps]
    smooth = "readings scaled by a smooth course along the chain"
    for scales, first in (
        (np.random.default_rng(3).normal(size=25), "sensor-gain"), (np.linspace(-1, 1, 25), smooth),
    ):  # fmt: skip
        column = tangent.new(path.free(path.rows((scales * field)[None])))[:, 0]
        faulty = replace(tangent, residual=tangent.residual + 20 * column / np.linalg.norm(column))
        found = {one.name: one.evidence for one in screen(faulty, CATALOGUE, np.random.default_rng(0), 40)}
        assert max(found, key=lambda name: found[name]) == first
        assert abs(found[smooth] - found["sensor-gain"]) > 5


def test_velocities_are_the_slopes_of_what_the_field_is_read_as(monkeypatch):
    """A reading of u**3 goes with one of 3 u**2 v."""
    tangent = tangent_of("phi4")
    caught = []
    monkeypatch.setattr(misreadings, "as_candidate", lambda _tangent, _change, columns, **_: caught.append(columns))
    misreadings.by_law(tangent, lambda _path, u: u[None] ** 3, random=False)
    path = tangent.paths[0]
    u, v = (one[:: path.steps] for one in path.fields())
    for slopes, columns in zip((0 * v, 3 * u**2 * v), caught, strict=True):
        expected = path.free(path.rows(np.stack([u**3, slopes], axis=1)[None, :, :, None]))
        np.testing.assert_allclose(columns, expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))
