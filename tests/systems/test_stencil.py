"""Sites, ends and windows: what the sites beyond the ends repeat, and where terms have a value."""

import numpy as np
import pytest

from latticebench.systems.errors import InputError
from latticebench.systems.stencil import Stencil, evaluate, ghosts, numbers, observed
from latticebench.systems.terms import Term, split

ENDS = ("free", "fixed", "periodic", "antiperiodic")


@pytest.mark.parametrize(
    ("ends", "wanted"),
    [
        ("free", [2, 1, 1, 2, 3, 4, 4, 3]),
        ("fixed", [0, 0, 1, 2, 3, 4, 0, 0]),
        ("periodic", [3, 4, 1, 2, 3, 4, 1, 2]),
        ("antiperiodic", [-3, -4, 1, 2, 3, 4, -1, -2]),
    ],
)
def test_two_sites_beyond_each_end_repeat_what_the_ends_say(ends, wanted):
    index, factor = ghosts(4, 2, 2, ends)
    np.testing.assert_array_equal(np.array([1.0, 2.0, 3.0, 4.0])[index] * factor, wanted)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("count", "left", "right"), [(1, 1, 1), (2, 2, 1), (2, 0, 2), (3, 3, 0), (5, 2, 2)])
def test_ghosts_agree_with_the_definitions_of_the_ends(neighbour, ends, count, left, right):
    u = np.random.default_rng(1).normal(size=count)
    index, factor = ghosts(count, left, right, ends)
    wanted = [neighbour(u, k, ends) for k in range(-left, count + right)]
    np.testing.assert_array_equal(u[index] * factor, wanted)


@pytest.mark.parametrize("ends", ["unknown", *ENDS])
def test_a_window_shows_each_inner_site_its_neighbour(neighbour, ends):
    u = np.random.default_rng(1).normal(size=(2, 7))
    stencil = Stencil.chain(7, (2, 1), ends)
    inner = np.arange(7)[stencil.inner]
    np.testing.assert_array_equal(stencil.own, np.arange(7)[observed(7, (2, 1), ends)])
    np.testing.assert_array_equal(inner, stencil.own)
    np.testing.assert_array_equal(stencil.border, [] if ends != "unknown" else [0, 1, 6])
    np.testing.assert_array_equal(numbers(7)[stencil.own], inner - 3)
    assert stencil.offsets == ((-2,), (-1,), (0,), (1,))
    for offset in stencil.offsets:
        wanted = [[neighbour(row, k + offset[0], ends) for k in inner] for row in u]
        np.testing.assert_array_equal(stencil.pad(u)[(slice(None), *stencil.window(offset))], wanted)
        np.testing.assert_array_equal(stencil.pad(u.T, after=1)[stencil.window(offset)].T, wanted)
        place, factor = stencil.neighbours(offset)
        np.testing.assert_array_equal(u[:, place] * factor, wanted)


@pytest.mark.parametrize("ends", ["unknown", *ENDS])
def test_a_lattice_of_two_axes_is_read_along_each_as_a_chain_is(neighbour, ends):
    u = np.random.default_rng(1).normal(size=(4, 5))
    stencil = Stencil((4, 5), ((1, 0), (1, 2)), ends)
    assert len(stencil.offsets) == 2 * 4
    inner = [(i, k) for i in range(4)[stencil.inner[0]] for k in range(5)[stencil.inner[1]]]
    np.testing.assert_array_equal(stencil.own, [5 * i + k for i, k in inner])
    for down, right in stencil.offsets:
        wanted = [neighbour([neighbour(row, k + right, ends) for row in u], i + down, ends) for i, k in inner]
        np.testing.assert_array_equal(stencil.pad(u)[stencil.window((down, right))].ravel(), wanted)
        place, factor = stencil.neighbours((down, right))
        np.testing.assert_array_equal(u.ravel()[place] * factor, wanted)


def test_unknown_ends_use_only_sites_whose_whole_stencil_was_observed():
    u = np.random.default_rng(1).normal(size=(3, 6))
    values = evaluate([Term("u[n+2]"), Term("u[n-1]")], u, None, None, np.arange(3.0), ends="unknown")
    np.testing.assert_array_equal(values[0, 0], u[:, 3:])
    np.testing.assert_array_equal(values[0, 1], u[:, 0:3])
    assert observed(6, (1, 2), "unknown") == slice(1, 4)
    assert observed(6, (1, 2), "free") == slice(0, 6)


@pytest.mark.parametrize(("ends", "count"), [("unknown", 2), ("free", 1), ("periodic", 1), ("antiperiodic", 1)])
def test_a_chain_shorter_than_the_stencil_is_refused_with_the_numbers(ends, count):
    reach = (1, 1) if ends == "unknown" else (2, 2)
    with pytest.raises(InputError, match=f"(have|has) {count}"):
        ghosts(count, *reach, ends)


def test_the_site_number_is_counted_from_the_middle():
    u = np.ones((2, 5))
    t = np.arange(2.0)
    for ends, wanted in (("free", [-2, -1, 0, 1, 2]), ("unknown", [-1, 0, 1])):
        values = evaluate(split("n*u[n]; u[n+1]; u[n-1]"), u, None, None, t, ends=ends)
        np.testing.assert_array_equal(values[0, 0, 0], wanted)


def test_a_missing_value_spoils_only_the_terms_that_see_it():
    u = np.ones((2, 6))
    u[0, 0] = np.nan
    terms = split("u[n]; u[n-1]; u[n-2]; u[n+1]")
    values = evaluate(terms, u, None, None, np.arange(2.0), ends="fixed")[0, :, 0]
    np.testing.assert_array_equal(np.isnan(values).nonzero(), [[0, 1, 2], [0, 1, 2]])
    np.testing.assert_array_equal(values[1:3, 0], [0, 0])


def test_time_velocity_and_input_reach_the_terms_that_name_them():
    draw = np.random.default_rng(0)
    u, v, f = draw.normal(size=(3, 4, 5))
    t = np.array([0.0, 0.1, 0.5, 0.6])
    values = evaluate(split("t*u[n]; v[n+1]; f[n-1]*u[n]; cos(2*t)"), u, v, f, t, ends="periodic")[0]
    np.testing.assert_allclose(values[0], t[:, None] * u)
    np.testing.assert_allclose(values[1], np.roll(v, -1, axis=1))
    np.testing.assert_allclose(values[2], np.roll(f, 1, axis=1) * u)
    np.testing.assert_allclose(values[3], np.cos(2 * t)[:, None] * np.ones(5))


@pytest.mark.parametrize("name", ["v", "f"])
def test_a_library_with_what_was_not_observed_is_refused(name):
    with pytest.raises(InputError, match=f"{name}1..{name}N"):
        evaluate([Term(f"{name}[n]")], np.ones((2, 3)), None, None, np.arange(2.0), ends="free")


@pytest.mark.parametrize("reach", [(1, 1), (2, 1), (0, 2)])
@pytest.mark.parametrize("ends", ["unknown", *ENDS])
def test_windows_read_the_sites_that_their_stencils_reach_and_no_others(reach, ends):
    stencil = Stencil.chain(40, reach, ends)
    for window in stencil.windows(5):
        sites = np.arange(40)[window.sites]
        assert 0 < len(sites) <= 5
        read = np.arange(40)[window.columns]
        assert len(window.place) == len(sites) + sum(reach)
        # Beyond an end that is not unknown, a site may be read as another's ghost.
        inner = sites[0] >= reach[0] and sites[-1] + reach[1] < 40
        if inner:
            assert read.tolist() == list(range(sites[0] - reach[0], sites[-1] + reach[1] + 1))
