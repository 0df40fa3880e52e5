"""Samples: what is invalid cannot be made, and only simulated ones know a truth."""

import numpy as np
import pytest

from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples, SimulatedSamples

T = np.arange(3.0)
U = np.ones((3, 2))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"t": T[:, None]}, "must be"),
        ({"u": U[:, 0]}, "must be"),
        ({"u": U[:2]}, "must be"),
        ({"t": T[:1], "u": U[:1]}, "1 row"),
        ({"u": U[:, :0]}, "no sites"),
        ({"t": np.array([0, np.nan, 1])}, "row 2, column t"),
        ({"t": np.array([0, 2.0, 1])}, "row 3, column t"),
        ({"t": 1e-60 * T}, "row 2, column t: it is 1e-60 after the row before, less than 1e-50; .* smaller unit"),
        ({"v": U[:, :1]}, "v has shape"),
        ({"f": U[:2]}, "f has shape"),
        ({"u": np.full((3, 2), np.nan)}, "missing"),
        ({"u": np.array([[1, 2], [3, np.inf], [1, 2]])}, "row 2, column u2"),
        ({"v": 1j * U}, "v is complex"),
        ({"f": 1j * U}, "f is complex"),
        ({"sigma": -1.0}, "sigma"),
        ({"sigma": np.nan}, "sigma"),
        ({"ends": "open"}, "ends 'open'"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_invalid_samples_cannot_be_made(fields, words):
    with pytest.raises(InputError, match=words) as caught:
        Samples(**{"t": T, "u": U, "source": "the pendulum", **fields})
    assert str(caught.value).startswith("the pendulum: ")


def test_samples_know_whether_they_are_even_complex_and_complete():
    assert Samples(T, U).is_even
    assert not Samples(np.array([0, 1, 2.1]), U).is_even
    assert not Samples(T, U).is_complex
    assert Samples(T, U * 1j).is_complex
    holed = U.copy()
    holed[1, 1] = np.nan
    assert not Samples(T, U).has_missing
    assert all(Samples(T, U, **{name: holed}).has_missing for name in ("v", "f"))
    assert Samples(T, holed).has_missing


def test_mirroring_twice_gives_the_samples_back():
    draw = np.random.default_rng(0)
    one = Samples(T, *draw.normal(size=(3, 3, 2)))
    once = one.mirrored()
    for name in "uvf":
        np.testing.assert_array_equal(getattr(once, name), -getattr(one, name))
        np.testing.assert_array_equal(getattr(once.mirrored(), name), getattr(one, name))


def test_rows_of_samples_have_what_was_observed_then_and_their_truth():
    draw = np.random.default_rng(0)
    u, v, f = draw.normal(size=(3, 3, 2))
    part = Samples(T, u, v, f).of_rows(slice(1, None))
    for name, whole in (("t", T), ("u", u), ("v", v), ("f", f)):
        np.testing.assert_array_equal(getattr(part, name), whole[1:])
    assert Samples(T, u).of_rows(slice(0, None, 2)).v is None
    simulated = SimulatedSamples(T, u, equation="u[n]", exact=Samples(T, 2 * u), rate=3 * u).of_rows(slice(1, None))
    np.testing.assert_array_equal(simulated.exact.u, 2 * u[1:])
    np.testing.assert_array_equal(simulated.rate, 3 * u[1:])
    assert SimulatedSamples(T, u).of_rows(slice(2)).rate is None


def test_simulated_samples_derive_their_truth_and_observed_ones_have_none():
    one = SimulatedSamples(T, U, sigma=0.3, equation="2*u[n+1]-u[n]**3", exact=Samples(T, U), rate=2 * U, noise=0.1)
    np.testing.assert_allclose(one.truth(library("own", "u[n]; u[n+1]; u[n]**3")), [0, 2, -1])
    assert one.truth(library("own", "u[n]; u[n+1]")) is None
    seen = one.observed()
    assert type(seen) is Samples
    assert not isinstance(seen, SimulatedSamples)
    assert seen.sigma is None
    assert not any(value is one.exact or value is one.rate for value in vars(seen).values())
