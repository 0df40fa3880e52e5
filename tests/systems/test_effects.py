"""The catalogue of effects: every text has a value on its lattices, and the list is complete."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.errors import InputError
from latticebench.systems.stencil import evaluate
from latticebench.systems.terms import Term

EXPECTED = """
damping quadratic-drag dry-friction nonlinear-damping onsite-linear onsite-quadratic onsite-cubic onsite-quintic
constant-force drive parametric-drive known-input gradient trap memory kick next-neighbour quadratic-coupling
bond-damping nonlinear-coupling asymmetric-coupling intersite-nonlinearity long-range nonlinear-loss gain-loss defect
bond-defect local-damping local-drive local-kick unequal-masses ends disorder sensor-offset sensor-gain sensor-curve
sensor-drift sensor-wander sensor-hum clock unequal-bonds sensor-jump sensor-saturation
coefficient-drift coefficient-jump clock-jump sensor-lag onsite-bilinear local-bilinear bilinear-coupling
local-cubic own-rates sensor-cyclic sensor-gain-drift sensor-gain-jump sensor-crosstalk sensor-imbalance sensor-clock
side-mass local-friction swaying-support
"""
REAL = {"sensor-crosstalk", "damping", "nonlinear-damping", "bond-damping", "nonlinear-loss", "gain-loss"}
LATTICES = [(1, False), (1, True), (2, False), (2, True)]


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda one: one.name)
def test_every_text_of_the_catalogue_has_a_value_on_its_lattices(effect):
    draw = np.random.default_rng(4)
    used = 0
    for order, is_complex in LATTICES:
        texts = effect.texts(order, is_complex)
        used += len(texts)
        if not texts:
            continue
        u, v = (draw.normal(size=(3, 7)) + 1j * is_complex * draw.normal(size=(3, 7)) for _ in range(2))
        if not is_complex:
            u, v = u.real, v.real
        terms = [Term(text) for text in texts]
        # The clock's v is du/dt, whatever the order; no other effect needs a velocity that is not there.
        seen = v if order == 2 or effect.acts == "clock" else None
        values = evaluate(terms, u, seen, draw.normal(size=(3, 7)), np.arange(3.0), ends="free")
        assert values.shape == (1 + is_complex, len(terms), 3, 7)
        assert np.all(np.isfinite(values))
        assert np.any(values != 0)
    assert used > 0


def test_no_two_effects_have_the_same_name():
    names = [one.name for one in CATALOGUE]
    assert len(set(names)) == len(names)


def test_the_catalogue_has_every_effect_that_was_asked_for_and_each_says_what_to_look_for_and_where_to_read():
    assert {one.name for one in CATALOGUE} >= set(EXPECTED.split())
    assert all(one.look_for and one.source for one in CATALOGUE)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda one: one.name)
def test_a_complex_coefficient_is_two_terms_t_and_i_times_t_unless_the_name_says_real(effect):
    u = np.random.default_rng(2).normal(size=(2, 7, 2)) @ [1, 1j]
    for order in (1, 2):
        texts = effect.texts(order, True)
        if not texts:
            continue
        assert len(texts) == (1 if effect.name in REAL else 2)
        assert len(effect.texts(order, False)) <= 1
        if len(texts) == 2:
            terms = [Term(text) for text in texts]
            real, imaginary = evaluate(terms, u, u, u.real, np.arange(2.0), ends="periodic")
            plain, turned = real + 1j * imaginary
            assert np.allclose(turned, 1j * plain)


@pytest.mark.parametrize(
    ("name", "order", "is_complex", "text"),
    [
        ("damping", 2, False, "v[n]"), ("damping", 1, True, "u[n]"), ("gradient", 2, False, "n"),
        ("gradient", 1, True, "n*u[n]"), ("onsite-cubic", 1, True, "abs(u[n])**2*u[n]"),
        ("onsite-cubic", 2, False, "u[n]**3"),
    ],
)  # fmt: skip
def test_the_same_effect_reads_differently_on_different_lattices(name, order, is_complex, text):
    assert find(name).texts(order, is_complex)[0] == text


@pytest.mark.parametrize("name", ["quadratic-drag", "dry-friction"])
def test_friction_that_needs_a_velocity_is_not_for_first_order_lattices(name):
    assert find(name).texts(1, False) == ()
    assert find(name).texts(1, True) == ()
    assert find(name).texts(2, False) != ()


@pytest.mark.parametrize("name", ["intersite-nonlinearity", "nonlinear-loss", "gain-loss"])
def test_effects_of_complex_fields_are_not_for_real_ones(name):
    assert find(name).texts(1, False) == find(name).texts(2, False) == ()
    assert find(name).texts(1, True) != ()


def test_an_unknown_name_is_refused_with_one_that_is_near():
    with pytest.raises(InputError, match="dry-friction"):
        find("dry-frction")
