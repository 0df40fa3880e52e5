"""Specimens: of the size that was asked for, the same from the same draws, and made without the fits' dynamics."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.trials.faults import (
    BLIND,
    FAULTS,
    FIFTH_BLIND,
    FOURTH_BLIND,
    NONE,
    OTHERS,
    SECOND_BLIND,
    THIRD_BLIND,
    sensible,
)
from latticebench.bench.trials.sight import Sight
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library

SMALL = {"sites": 7, "samples": 20, "span": 4.0}
NAMES = ["phi4", "sine-gordon", "dnls", "ginzburg-landau"]
SOME = [
    ("phi4", "drive"), ("phi4", "long-range"), ("phi4", "ends"), ("phi4", "known-input"), ("phi4", "clock"),
    ("phi4", "sensor-curve"), ("phi4", "other: noise-force"), ("dnls", "disorder"), ("dnls", "unequal-masses"),
    ("dnls", "memory"), ("phi4", "other: jittered-rows"), ("dnls", "sensor-offset"), ("phi4", "other: moving-spot"),
    ("phi4", "other: slow-sensor"), ("dnls", "other: side-resonator"), ("dnls", "other: retarded-coupling"),
    ("phi4", "other: slipping-spring"), ("dnls", "other: slow-heating"), ("dnls", "other: scanned-channels"),
    ("phi4", "other: mains-hum"), ("dnls", "other: inner-resonators"), ("phi4", "other: stray-spikes"),
    ("phi4", "other: two-level-defect"), ("dnls", "other: parallel-chain"), ("phi4", "other: wandering-reference"),
    ("dnls", "other: resampled-rows"),
]  # fmt: skip
# Of each kind of sizing (pushes, what is not seen, instruments) some are quick tests; the others are long.
EVERY = [
    pytest.param(name, effect, marks=() if (name, effect) in SOME else pytest.mark.slow)
    for name in ("phi4", "dnls")
    for effect in FAULTS
    if effect != NONE and sensible(effect, systems.find(name))
]
# One for each kind of draw: of places, times, frequencies, random forces, random coefficients, random readings.
DRAWN = [
    ("phi4", "drive"), ("dnls", "disorder"), ("dnls", "memory"), ("dnls", "sensor-offset"),
    ("phi4", "other: jittered-rows"), ("phi4", "other: noise-force"), ("phi4", "other: stray-spikes"),
    ("phi4", "other: wandering-reference"),
]  # fmt: skip


def made(name, effect, z, seed=2, **options):
    conditions = Conditions(**{**SMALL, "variation": True, **options})
    return make(systems.find(name), effect, z, np.random.default_rng(seed), conditions)


@functools.cache
def drawn(name, effect, z=15, **options):
    return made(name, effect, z, **options)


@pytest.mark.parametrize(("name", "effect"), EVERY)
def test_an_effect_is_as_visible_as_was_asked_for(name, effect):
    one = drawn(name, effect)
    if not FAULTS[effect].sized:
        assert one.z > 0
    else:
        assert one.z == pytest.approx(15, rel=0.1)
        assert one.amount != 0
    assert one.effect == effect


def test_other_ends_are_as_large_as_they_are():
    assert drawn("phi4", "ends").amount == 1


@pytest.mark.parametrize(
    ("name", "effect", "terms"),
    [
        ("phi4", "damping", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3", "-v[n]"]),
        ("phi4", "gradient", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3", "n"]),
        ("sine-gordon", "trap", ["u[n+1]+u[n-1]-2*u[n]", "sin(u[n])", "n**2*u[n]"]),
    ],
)
def test_its_size_is_the_coefficient_over_the_standard_error_of_a_fit(name, effect, terms):
    one = drawn(name, effect, z=12, noise=0.002)
    samples = replace(one.samples.observed(), ends="free")
    error = Trajectory().fit([samples], library("true", terms), 2, seed=1).stderr[-1]
    assert np.real(one.amount) / error == pytest.approx(12, rel=0.25)


@pytest.mark.parametrize(("name", "effect"), DRAWN)
def test_the_same_generator_gives_the_same_specimen(name, effect):
    one, other, third = drawn(name, effect), made(name, effect, 15), made(name, effect, 15, seed=3)
    assert np.array_equal(one.samples.u, other.samples.u)
    assert one.samples.v is None or np.array_equal(one.samples.v, other.samples.v)
    assert one.about == other.about
    assert one.amount == other.amount
    assert not np.array_equal(one.samples.u, third.samples.u)


def test_nothing_in_it_is_the_systems_own_motion_with_noise():
    system = systems.find("phi4")
    one = drawn("phi4", NONE, noise=0.02)
    rms = np.sqrt(np.mean((one.clean.u - np.mean(one.clean.u)) ** 2))
    left = (one.samples.u - one.clean.u) / (0.02 * rms)
    assert np.std(left) == pytest.approx(1, abs=0.2)
    assert one.amount == one.z == 0
    assert one.samples.sigma == pytest.approx(0.02 * rms)
    assert one.samples.u.shape == one.samples.v.shape == (20, 7)
    assert drawn("phi4", NONE, velocities=False).samples.v is None
    assert system.is_complex is False


def test_making_one_does_not_call_the_dynamics_that_fits_use(monkeypatch):
    """But for the size, everything is made without it."""

    def forbidden(*_, **__):
        raise AssertionError("the dynamics of fits was used")

    class Guess:
        """Any change has the size 15."""

        def size(self, found):
            return 15 * float(np.max(np.abs(found[0])) > 0)

        def fitted(self, found):
            return SimpleNamespace(size=self.size(found))

        def apart(self, _):
            return 0.0

    monkeypatch.setattr(Sight, "of", lambda *_: Guess())
    monkeypatch.setattr(Dynamics, "linear", forbidden)
    for name, effect in SOME:
        made(name, effect, 15)


@pytest.mark.parametrize("name", NAMES)
def test_what_the_equation_has_already_is_no_effect_of_it(name):
    system = systems.find(name)
    lacking = {effect.name for effect in CATALOGUE if sensible(effect.name, system)}
    has = {"phi4": {"onsite-linear", "onsite-cubic"}, "sine-gordon": set(), "dnls": set()}
    assert not lacking & has.get(name, {"onsite-linear", "onsite-cubic", "damping", "nonlinear-loss"})
    assert {"drive", "defect", "ends", "sensor-offset", "disorder"} <= lacking
    # A wrong clock changes a unit; only velocities, which have another one, show it.
    assert ("clock" in lacking) == (system.order == 2)
    if not system.is_complex:
        assert not lacking & {"nonlinear-loss", "gain-loss", "intersite-nonlinearity"}
    if system.order == 1:
        assert not lacking & {"dry-friction", "quadratic-drag"}
    assert {other for other in OTHERS if sensible(other, system)} >= {"other: wavy-bonds", "other: saturation"}


def test_the_blind_sets_are_outside_the_catalogue_and_beside_each_other():
    assert [len(BLIND), len(SECOND_BLIND), len(THIRD_BLIND), len(FOURTH_BLIND)] == [9, 8, 8, 8]
    assert len(FIFTH_BLIND) == 18
    assert len(OTHERS) == 8 + 9 + 8 + 8 + 8 + 18
    assert {*BLIND, *SECOND_BLIND, *THIRD_BLIND, *FOURTH_BLIND, *FIFTH_BLIND} < set(OTHERS)
    assert not set(OTHERS) & {one.name for one in CATALOGUE}


def test_a_fault_is_for_lattices_that_can_have_it():
    assert not sensible("other: phase-conjugation", systems.find("phi4"))
    assert not sensible("quadratic-coupling", systems.find("dnls"))
    assert not sensible("other: nonlocal-response", systems.find("sine-gordon"))
    assert not sensible("other: slipping-spring", systems.find("ginzburg-landau"))
    assert not sensible("local-damping", systems.find("dnls"))
    assert not sensible("other: bent-wire", systems.find("dnls"))
    assert not sensible("other: gyroscopic-bonds", systems.find("ginzburg-landau"))
    assert not sensible("other: mixer-imbalance", systems.find("phi4"))


def test_every_effect_of_the_catalogue_can_be_made():
    # No lattice of the paper is real and of first order.
    assert {one.name for one in CATALOGUE} - {"own-rates"} <= set(FAULTS)


def test_an_unknown_effect_is_refused_by_name():
    with pytest.raises(InputError, match="dampng"):
        drawn("phi4", "dampng")
    with pytest.raises(InputError):
        sensible("dampng", systems.find("phi4"))


def test_of_two_effects_one_at_most_may_be_of_the_instrument():
    for pair in ("sensor-gain+clock", "damping+memory"):
        with pytest.raises(InputError, match="one at most may be of the instrument"):
            drawn("phi4", pair)


def test_an_effect_that_does_nothing_is_refused():
    with pytest.raises(InputError, match="of no size is visible"):
        drawn("phi4", "onsite-linear")


def test_a_record_so_dense_that_its_residual_has_no_line_can_be_sized():
    one = make(
        systems.find("phi4"),
        "other: cubic-drag",
        10.0,
        np.random.default_rng(1),
        Conditions(sites=7, samples=800, span=4.0),
    )
    assert one.apart >= 0
