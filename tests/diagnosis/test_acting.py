"""Each way of acting: its derivatives, what the score says of it, its words; and one that a user adds."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting import WAYS, Chain, Force, Placed
from latticebench.diagnosis.cure import corrected, cure
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.horizon import Layout, follow, linearised
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.past import past_of, with_unread
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.systems.effects import CATALOGUE, HOW, Effect, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES, NOISE, SMALL = 5, 0.01, 1e-5
COUPLING = "u[n+1]+u[n-1]-2*u[n]"
REAL = (library("duffing", f"{COUPLING}; u[n]; u[n]**3"), (0.9, -1.0, -0.3))
COMPLEX = (library("turning", f"i*({COUPLING}); i*abs(u[n])**2*u[n]"), (0.8, 0.6))
EVERY_WAY = [(way, False) for way in WAYS if way != "imbalance"]
SECOND_ORDER = ("clock", "clock jump", "lag", "sensor clock", "side mass", "support")
EVERY_WAY += [(way, True) for way in WAYS if way not in (*SECOND_ORDER, "cyclic")]
# These have no numbers: the noise says how far a zero wanders.
NUMBERED = [pair for pair in EVERY_WAY if pair[0] not in ("ends", "wander")]


def beside(u):
    """The sum of both neighbours on a chain with free ends."""
    return np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])


def solved(rate, start, t):
    return solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T


def real_rate(t, y, extra=lambda t, u, v: 0.0):
    u, v = np.split(y, 2)
    return np.concatenate([v, 0.9 * (beside(u) - 2 * u) - u - 0.3 * u**3 + extra(t, u, v)])


def turning_rate(_, y):
    return 1j * (0.8 * (beside(y) - 2 * y) + 0.6 * np.abs(y) ** 2 * y)


@functools.cache
def recording(is_complex, extra=None):
    """Five sites read 90 times with noise; velocities and an input, too, where the field is real."""
    t, draw, n = np.linspace(0.5, 12.5, 90), np.random.default_rng(0), np.arange(SITES)
    if is_complex:
        u = solved(turning_rate, (1 + 0.3 * n) * np.exp(1j * n**2) / 2, t)
        u = u + NOISE * (draw.normal(size=u.shape) + 1j * draw.normal(size=u.shape))
        return Samples(t, u, source="turning", ends="free")
    rate = real_rate if extra is None else functools.partial(real_rate, extra=extra)
    y = solved(rate, np.concatenate([np.sin(1 + 1.3 * n), 0.5 * np.cos(2 * n)]), t)
    y = y + NOISE * draw.normal(size=y.shape)
    return Samples(t, y[:, :SITES], y[:, SITES:], np.sin(1.7 * t)[:, None] * np.cos(n), source="duffing", ends="free")


# Lattices without what the catalogue has for complex fields only.
EXTRA = (Effect("staggered", "u[n]", acts="alternating"),)


@functools.cache
def problem_of(is_complex):
    declared, _ = COMPLEX if is_complex else REAL
    return Problem.of(declared, 1 if is_complex else 2, [recording(is_complex)], (*CATALOGUE, *EXTRA))


def candidate(problem, way):
    """A candidate of a way of acting with as many numbers as it has anywhere, in the middle of where it may be.

    Its strength may be of either sign.
    """
    found = [one for one in problem.candidates if isinstance(one, WAYS[way]) and one.effect.acts == way]
    if way == "everywhere":
        return next(one for one in found if one.effect.name == "next-neighbour")
    found = [one for one in found if not (one.general or one.effect.takes)] or found
    most = max(len(one.numbers) for one in found)
    widest = [one for one in found if len(one.numbers) == most]
    # At the middle delay, an end of the past falls on a stage of the integrator, where its derivative jumps.
    return widest[len(widest) // (3 if way == "delayed" else 2)]


def with_strength(one, size):
    strengths = size * np.where(np.arange(len(one.strength)) % 2, -1.2, 1.0)
    return one.moved([*strengths, *one.numbers[len(one.strength) :]])


def whole(problem, length=10_000, substeps=3):
    layout = Layout.of(problem, min(length, len(problem.data[0].t)), None, SMALL)
    return replace(layout, substeps=tuple(np.full_like(one, substeps) for one in layout.substeps))


def near(problem, layout, model=None):
    seen = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    return seen if model is None else with_unread(problem, layout, model, seen)


def true_model(problem, *effects):
    values = (COMPLEX if problem.chain.is_complex else REAL)[1]
    return Model(problem.declared, problem.order, values, effects)


# Derivatives ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("way", "is_complex"), NUMBERED)
def test_derivatives_of_readings_by_start_and_numbers_are_finite_differences_of_the_motion(way, is_complex):
    problem = problem_of(is_complex)
    layout = whole(problem, 30)
    model = true_model(problem, with_strength(candidate(problem, way), 0.05))
    path = follow(model, layout, near(problem, layout, model))
    found = linearised(path, layout)
    numbers, size, step = model.numbers, path.size, 1e-5

    def readings(change):
        """Readings of the motion with other numbers, every piece beginning as before."""
        states = [
            nodes + np.einsum("v,pmvs->pms", change, moves[:, :, size:])
            for nodes, moves in zip(found.nodes, found.moves, strict=True)
        ]
        return follow(model.moved(numbers + change), layout, states).level

    # Other numbers are derived by as if an instrument's fault were small.
    varied = range(model.blocks[0].start if model.instruments(0) else 0, len(numbers))
    for k in varied:
        change = step * max(1.0, abs(numbers[k])) * np.eye(len(numbers))[k]
        difference = (readings(change) - readings(-change)) / (2 * change[k])
        scale = np.max(np.abs(difference)) + 1e-6
        np.testing.assert_allclose(found.slope[:, :, size + k], difference, atol=2e-4 * scale)


# What the score says --------------------------------------------------------------------------------------------------


@functools.cache
def fitted_without(is_complex):
    problem = problem_of(is_complex)
    layout = whole(problem, substeps=1)
    found = fit(true_model(problem), layout, near(problem, layout), structure=Structure())
    return problem, found


@functools.cache
def tangent_without(is_complex):
    return Tangent(fitted_without(is_complex)[1])


@pytest.mark.parametrize(("way", "is_complex"), NUMBERED)
def test_what_the_score_promises_is_what_a_fit_wins_where_the_effect_is_weak(way, is_complex, monkeypatch):
    problem, plain = fitted_without(is_complex)
    one = candidate(problem, way).with_past(past_of(problem, plain.layout, plain.model, plain.followed.nodes))
    (scored,) = tangent_without(is_complex).scored([one])
    # The score fits the strengths and, near a strength of zero, nothing else.
    model = plain.model.with_effect(replace(scored.placed, **{name: getattr(one, name) for name in one.shape}))
    layout = plain.layout
    nodes = with_unread(problem, layout, model, plain.followed.nodes)
    found = fit(model, layout, nodes, structure=Structure(), noise=plain.noise, steps=12)
    won = plain.cost - found.cost
    if one.positive:
        # It may seem to be negative.
        monkeypatch.setattr(type(one), "positive", False)
        (free,) = tangent_without(is_complex).scored([one])
        assert scored.gain == (free.gain if free.placed.strength[0] > 0 else 0)
        assert free.gain > 0
    else:
        assert scored.gain > 0
    # A shape that is fitted, too, may win more.
    most = np.inf if one.shape else 1.3 * scored.gain + 1.0
    assert 0.7 * scored.gain - 1.0 < won < most


@pytest.mark.parametrize(("way", "is_complex"), NUMBERED)
def test_the_score_finds_a_weak_effect_and_its_strength(way, is_complex):
    """The readings of a model with the effect, put in the place of those without it."""
    problem = problem_of(is_complex)
    # On this complex field, forces are felt at less; a drift is a force of which half is felt.
    one = candidate(problem, way)
    size = (0.003 if is_complex and not one.instrument else 0.01) * (2 if way in ("ramp", "gain drift") else 1)
    one = with_strength(one, size)
    layout = whole(problem, substeps=1)
    nodes = fitted_without(is_complex)[1].followed.nodes
    for part in (0.3, 1.0):
        model = true_model(problem, with_strength(one, part * size))
        path = follow(model, layout, with_unread(problem, layout, model, nodes))
        nodes = tuple(one[..., : layout.plain.read] for one in path.nodes)
    record = problem.records[0]
    draw = np.random.default_rng(1)
    value = path.level.reshape(record.value.shape)
    value = value + NOISE * draw.normal(size=value.shape)
    seen = replace(layout, records=(replace(record, value=value),))
    plain = fit(true_model(problem), seen, near(problem, layout), structure=Structure())
    absent = one.moved([*np.zeros(len(one.strength)), *one.numbers[len(one.strength) :]])
    past = past_of(problem, seen, plain.model, plain.followed.nodes)
    (scored,) = Tangent(plain).scored([absent.with_past(past)])
    model = plain.model.with_effect(scored.placed)
    full = fit(model, seen, with_unread(problem, seen, model, plain.followed.nodes), structure=Structure(), steps=12)
    won = plain.cost - full.cost
    assert won > 3
    assert scored.gain == pytest.approx(won, rel=0.35, abs=3)
    if not one.shape:
        block = full.model.blocks[0]
        assert np.max(np.abs((full.model.numbers[block] - one.numbers) / full.stderr[block])) < 4.5


@pytest.mark.parametrize("way", ["pulse", "pulse at one site"])
def test_a_model_with_a_kick_is_fitted_only_where_its_middle_is_among_the_readings(way):
    problem, plain = fitted_without(False)
    kick = candidate(problem, way)
    begin, end = problem.data[0].t[[0, -1]]
    for at, fitted in ((begin, True), (end, True), (begin - 0.3, False), (end + 0.3, False)):
        model = plain.model.with_effect(kick.moved([0.01, at, 0.5]))
        found = fit(model, plain.layout, plain.followed.nodes, structure=Structure(), noise=plain.noise, steps=2)
        assert (found is not None) == fitted


def test_of_several_recordings_kicks_are_sought_in_the_longest_and_may_be_in_any():
    whole = recording(False)
    short, early = (replace(whole, t=whole.t[:60] + 100, u=whole.u[:60], v=whole.v[:60], f=whole.f[:60]), whole)
    problem = Problem.of(REAL[0], 2, [short, early], (find("kick"), find("drive")))
    assert problem.scene.seen == (0.5, short.t[-1])
    kicks = [one for one in problem.candidates if one.effect.name == "kick"]
    assert min(one.at for one in kicks) == 0.5
    assert max(one.at for one in kicks) < 12.5
    assert kicks[0].moved([0.1, 103.0, 0.5]).possible
    assert {one.middle for one in problem.candidates if one.effect.name == "drive" and not one.general} == {6.5}


# Words ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("way", "is_complex"), EVERY_WAY)
def test_every_way_of_acting_is_said_in_words_and_in_mathematics(way, is_complex):
    problem = problem_of(is_complex)
    chain = problem.chain
    one = with_strength(candidate(problem, way), 0.1)
    assert len(one.labels(chain)) == len(one.strength)
    assert len(one.numbers) == len(one.strength) + len(one.shape)
    summands, sentences = one.summands(chain), one.sentences(chain)
    assert summands or sentences
    for summand in summands:
        assert summand.text in one.labels(chain)
        assert str(summand.body)
        assert np.isfinite(summand.coefficient)
    assert all("\n" not in line and line for line in sentences)
    assert all(isinstance(value, (float, int, str)) for value in one.settings().values())
    assert all(np.isfinite(value) for value in one.natural(chain, 1.0).values())
    assert one.site is None or one.settings()["site"] == one.site + 1
    assert HOW[way]
    assert hash(one.place) == hash(one.moved(one.numbers).place)


@pytest.mark.parametrize(("ends", "moving"), [("free", (0, 1, 2, 3)), ("unknown", (1, 2))])
def test_offsets_beside_unknown_ends_name_the_sensors_that_are_taken_as_right(ends, moving):
    chain = Chain(sites=4, order=2, is_complex=False, levels=1, ends=ends, moving=moving, reach=1)
    one = WAYS["offset"](effect=find("sensor-offset"), sites=moving, parts=1, every=True, strength=(0.1,) * len(moving))
    assert [line for line in one.sentences(chain) if "u1 and u4" in line] == [
        "these offsets are relative to the zeros of u1 and u4, which are taken as right"
    ] * (ends == "unknown")


def test_any_two_ways_of_acting_are_told_apart_by_the_same_measurement_in_either_order():
    for one in WAYS.values():
        for other in WAYS.values():
            assert one.separated_from(other) == other.separated_from(one)


def test_a_hum_goes_as_far_to_either_side_as_it_says():
    turning = WAYS["hum"](effect=find("sensor-hum"), sites=(0,), texts=("1", "i*1"), omega=2.0, strength=(1, 0, 0, 1))
    t = np.linspace(0, 10, 500)
    added = turning.misread(t, np.zeros((500, 1, 2, 3))).added
    assert np.max(np.hypot(added[:, 0, 0], added[:, 0, 1])) == pytest.approx(turning.size)
    assert turning.size == pytest.approx(1.0)


def test_no_hum_is_looked_for_beside_sites_without_an_equation():
    data = recording(False)
    for ends, sites in (("free", {None, 0, 1, 2, 3, 4}), ("unknown", {2})):
        problem = Problem.of(REAL[0], 2, [replace(data, ends=ends)], CATALOGUE)
        assert {one.site for one in problem.candidates if one.effect.name == "sensor-hum"} == sites


# From outside ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def ramped():
    """A force that grows from the beginning on, as a user may write it; the name of its way of acting."""

    @dataclass(frozen=True, eq=False, kw_only=True)
    class Ramped(Placed, acts="ramped", how="the formula times the time since the first reading"):
        text: str
        begin: float

        @classmethod
        def places(cls, effect, scene):
            for text in scene.terms(effect):
                yield cls(effect=effect, text=text, begin=scene.begin, strength=(0.0,))

        def labels(self, chain):
            return (f"(t-{self.begin:.4g})*{self.text}",)

        def forces(self, chain):
            return [Force(self.text, self.strength[0], {0: 1.0}, None, lambda t: (t - self.begin)[None, :, None])]

        def sentences(self, chain):
            return [f"{self.text} grows as {self.strength[0]:.3g} times the time"]

    yield "ramped"
    del WAYS["ramped"], HOW["ramped"]


def test_a_way_of_acting_that_a_user_adds_is_found_in_data_made_with_it(ramped):
    catalogue = (find("damping"), find("defect"), find("sensor-offset"), Effect("ageing", "u[n]", acts=ramped))
    data = recording(False, extra=lambda t, u, v: -0.03 * (t - 0.5) * u)
    found = diagnose(REAL[0], 2, [replace(data, f=None)], catalogue)
    (ageing,) = found.findings
    assert ageing.name == "ageing"
    assert found.verdict == "explained"
    ((value, error),) = ageing.values.values()
    assert value == pytest.approx(-0.03, abs=4 * error)
    assert error < 0.003
    assert ageing.placed.sentences(found.after.chain)


# As terms, and corrected readings -------------------------------------------------------------------------------------

# What depends on the past or on another clock is no term of the state.
UNSAID = ("delayed", "clock", "side mass", "support")
MOVING = [pair for pair in EVERY_WAY if not WAYS[pair[0]].instrument and pair[0] not in (*UNSAID, "ends")]
# A clock that jumps makes other times of the readings, not other readings.
READING = [pair for pair in EVERY_WAY if WAYS[pair[0]].instrument and pair[0] not in (*UNSAID, "wander", "clock jump")]


def test_rates_of_each_sites_own_are_looked_for_where_offsets_of_sensors_do_not_do_the_same() -> None:
    t = np.linspace(0, 10, 101)
    samples = Samples(t, np.cos(t[:, None] + np.arange(4)) + 0.1 * t[:, None], ends="free")
    for declared, there in ((COUPLING, 0), ("sin(u[n+1]-u[n])+sin(u[n-1]-u[n])", 1)):
        problem = Problem.of(library("own", declared), 1, [samples], [find("own-rates")])
        assert len(problem.candidates) == there


def forces(dynamics: Dynamics, coefficients: np.ndarray, is_complex: bool) -> np.ndarray:
    """The right-hand side at a few states and times."""
    draw, t = np.random.default_rng(1), np.array([0.7, 3.0, 9.1])
    states = draw.normal(size=(len(t), dynamics.order * dynamics.parts * dynamics.count))
    f = None if is_complex else draw.normal(size=(1, len(t), dynamics.sites))
    return np.asarray(dynamics.linear(coefficients, t, states, f, None, derivatives=False)[0])


@pytest.mark.parametrize(("way", "is_complex"), MOVING)
def test_an_effect_as_terms_pushes_every_site_as_the_model_does(way: str, is_complex: bool) -> None:
    problem = problem_of(is_complex)
    placed = with_strength(candidate(problem, way), 0.3)
    model = true_model(problem, placed)
    found = cure(model, problem.chain)
    assert found.left_out == ()
    assert found.terms[: len(model.coefficients)] == problem.declared.texts
    whole = model.assembled(problem.plain, problem.chain)
    expected = forces(whole.dynamics, whole.coefficients, is_complex)
    terms = library("cured", "; ".join(found.terms)).terms
    again = Dynamics(terms, problem.order, is_complex, problem.chain.sites, found.ends)
    values = forces(again, np.array([*model.coefficients, *placed.strength]), is_complex)
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-9)
    without = true_model(problem).assembled(problem.plain, problem.chain)
    assert np.max(np.abs(forces(without.dynamics, without.coefficients, is_complex) - expected)) > 1e-3


@pytest.mark.parametrize(("way", "is_complex"), READING)
def test_corrected_readings_are_those_of_an_instrument_without_the_fault(way: str, is_complex: bool) -> None:
    problem, samples = problem_of(is_complex), recording(is_complex)
    # What turns a swing too far stays.
    placed = with_strength(candidate(problem, way), 0.01 if way == "sensor clock" else 0.2)
    fields = [samples.u] if is_complex else [samples.u, samples.v]
    field = np.stack([np.stack([one.real, one.imag][: 1 + is_complex], axis=1) for one in fields], axis=1)
    read = field + placed.misread(samples.t, field).added
    parts = read[:, :, 0] + (1j * read[:, :, 1] if is_complex else 0)
    faulty = replace(samples, u=parts[:, 0], v=None if is_complex else parts[:, 1])
    model = Model(problem.declared, problem.order, true_model(problem).coefficients, (placed,))
    again = corrected(model, faulty, 0)
    np.testing.assert_allclose(again.u, samples.u, atol=1e-9)
    if not is_complex:
        np.testing.assert_allclose(again.v, samples.v, atol=1e-9)
    assert np.max(np.abs(faulty.u - samples.u)) > 1e-3
    assert cure(model, problem.chain).terms == problem.declared.texts


@pytest.mark.parametrize("way", UNSAID)
def test_what_no_term_can_say_is_told_by_its_name(way: str) -> None:
    problem = problem_of(False)
    placed = with_strength(candidate(problem, way), 0.3)
    found = cure(true_model(problem, placed), problem.chain)
    assert found.left_out == (placed.effect.name,)
    assert found.terms == problem.declared.texts


def test_other_ends_are_those_of_the_cured_equation() -> None:
    problem = problem_of(False)
    placed = candidate(problem, "ends")
    assert cure(true_model(problem, placed), problem.chain).ends == placed.other_ends() != problem.chain.ends
