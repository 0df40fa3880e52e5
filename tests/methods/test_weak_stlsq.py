"""pysindy's weak form on lattices: motions in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench import methods
from latticebench.methods.method import Fit, make, solve
from latticebench.methods.weak_stlsq import WeakSTLSQ, integrals
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples


def fit(samples: Samples, terms: str, order: int, **given: object) -> Fit:
    return solve(make(methods.find("weak-stlsq"), given), [samples], library("lib", terms), order, seed=1)


def walls(*, seen: bool, uneven: bool = False) -> Samples:
    """Three sites between walls, u_n'' = u_(n+1) + u_(n-1) - 2 u_n, as the sum of its modes."""
    t = np.linspace(0, 10, 80)
    if uneven:
        t = t + 0.04 * np.sin(11 * t)
    u, v = np.zeros((2, 80, 3))
    for mode, (size, phase) in enumerate([(1.0, 0.2), (0.7, 1.5), (0.4, 2.6)], start=1):
        shape, w = np.sin(mode * np.pi * np.arange(1, 4) / 4), 2 * np.sin(mode * np.pi / 8)
        u += size * np.cos(w * t + phase)[:, None] * shape
        v -= size * w * np.sin(w * t + phase)[:, None] * shape
    return Samples(t, u, v if seen else None, ends="fixed")


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("uneven", [True, False])
def test_the_modes_of_a_chain_between_walls_give_its_equation(*, seen: bool, uneven: bool) -> None:
    found = fit(walls(seen=seen, uneven=uneven), "u[n+1]; u[n-1]; u[n]; u[n]**3; u[n+1]-u[n-1]**3", 2)
    np.testing.assert_allclose(found.coefficients, [1, 1, -2, 0, 0], atol=1e-3)


def test_a_complex_field_with_an_input_has_its_real_coefficients() -> None:
    # u' = (0.3 i - 0.1) u + f, with f = cos t at every site.
    t = np.linspace(0, 12, 121)
    rate = 0.3j - 0.1
    driven = ((-rate) * np.cos(t) + np.sin(t)) / (1 + rate**2)
    u = driven[:, None] + np.exp(rate * t)[:, None] * np.array([1.0, -0.5j])
    found = fit(Samples(t, u, f=np.cos(t)[:, None] * np.ones(2)), "u[n]; i*u[n]; f[n]; i*f[n]", 1)
    np.testing.assert_allclose(found.coefficients, [-0.1, 0.3, 1.0, 0.0], atol=2e-3)


def test_integrating_by_parts_changes_the_sign_for_each_derivative() -> None:
    t = np.linspace(0, 6, 601)
    for derivative, of_sine in ((1, np.cos(t)), (2, -np.sin(t))):
        columns = np.column_stack([np.sin(t), of_sine])
        values, slopes = integrals(t, columns, derivative, 1.0, 20, 4)
        # What is linear between the points has an error of h^2 / 12.
        np.testing.assert_allclose(slopes[:, 0], values[:, 1], atol=2e-5)


def test_settings_out_of_range_and_too_few_samples_are_refused() -> None:
    for given in ({"widths": (0.5,)}, {"power": 1}, {"finer": (0,)}, {"thresholds": ()}):
        with pytest.raises(InputError, match="weak-stlsq"):
            make(WeakSTLSQ, given)
    t = np.linspace(0, 1, 7)
    with pytest.raises(InputError, match="too few samples for a window, there are 7"):
        fit(Samples(t, np.cos(t)[:, None] * np.ones(3)), "u[n]", 2, finer=(1,))


def test_a_damping_is_found_where_velocities_were_not_read() -> None:
    t = np.linspace(0, 20, 401)
    u = np.exp(-0.05 * t) * np.cos(2 * t)
    found = fit(Samples(t, u[:, None], ends="free"), "u[n]; v[n]", 2)
    np.testing.assert_allclose(found.coefficients, [-4 - 0.05**2, -0.1], rtol=0.02)


def test_a_window_is_never_narrower_than_a_few_samples() -> None:
    t = np.linspace(0, 8, 161)
    narrow = fit(Samples(t, np.cos(2 * t)[:, None], ends="free"), "u[n]", 2, widths=(1e-6,), finer=(1,))
    np.testing.assert_allclose(narrow.coefficients, [-4], rtol=0.05)


def test_what_the_narrowest_window_is_does_not_depend_on_the_unit_of_time() -> None:
    t = np.linspace(0, 8, 161)
    seconds, years = (
        fit(Samples(t * unit, np.cos(2 * t)[:, None], ends="free"), "u[n]", 2, widths=(1e-6,), finer=(1,))
        for unit in (1.0, 2.0**-25)
    )
    np.testing.assert_allclose(seconds.coefficients, years.coefficients * 2.0**-50, rtol=1e-6)
