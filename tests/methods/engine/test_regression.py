"""The rows that regressions solve: what is left out of them, when there is none, and sums in few rows."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.regression import Regression, joined, rows, sums, triangular
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

T = np.linspace(0.0, 6.0, 121)
# Not finite where u is 0, and where it is negative.
ROOT = library("root", "u[n]; sqrt(u[n])")


def oscillator(offset: float, size: float = 1.0) -> Samples:
    """One site that swings about an offset."""
    return Samples(T, size * (offset + np.cos(2 * T))[:, None], ends="free")


@pytest.mark.parametrize("whole", [rows, sums])
def test_rows_in_which_a_term_is_not_finite_are_counted_over_all_trajectories(whole) -> None:
    data = [oscillator(0.5), oscillator(0.2), oscillator(3.0)]
    negative = sum(int(np.sum(one.u < 0)) for one in data[:2])
    found = whole(data, ROOT, 2, "FiniteDifference")
    assert found.left_out == negative
    assert found.size == 3 * len(T) - negative
    assert found.status == f"{negative} of {3 * len(T)} rows left out: a term is not finite there"


@pytest.mark.parametrize("number", [1, 2])
def test_where_no_row_is_finite_the_terms_are_blamed_and_not_the_samples(number: int) -> None:
    with pytest.raises(InputError, match="in every row a term of the library is not finite"):
        rows([oscillator(-3.0)] * number, ROOT, 2, "FiniteDifference")


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_whether_anything_moves_does_not_depend_on_the_unit(size: float) -> None:
    one = library("one", "u[n]")
    with pytest.raises(InputError, match="nothing moves"):
        rows([Samples(T, np.full((len(T), 1), 0.7 * size), ends="free")], one, 2, "FiniteDifference")
    assert rows([oscillator(0.0, size)], one, 2, "FiniteDifference").size == len(T)
    # What is left of a large offset by its last digit is no motion, a millionth of it is.
    jitter = np.where(np.arange(len(T)) % 2, 1.0, 1 - 2e-16)
    with pytest.raises(InputError, match="nothing moves"):
        rows([Samples(T, size * jitter[:, None], ends="free")], one, 2, "FiniteDifference")
    assert rows([oscillator(1e6, size)], one, 2, "FiniteDifference").size == len(T)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 40])
def test_a_triangular_factor_has_the_same_sums_in_as_few_rows_as_columns(count: int) -> None:
    draw = np.random.default_rng(count)
    given = Regression(draw.normal(size=(count, 4)) * [1.0, 1e8, 1e-8, 1.0], draw.normal(size=count))
    found = triangular(given)
    assert len(found.target) == min(count, 5)
    for one in (given, found):
        one.design[:] /= [1.0, 1e8, 1e-8, 1.0]
    np.testing.assert_allclose(found.design.T @ found.design, given.design.T @ given.design, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.design.T @ found.target, given.design.T @ given.target, rtol=1e-9, atol=1e-9)
    assert found.target @ found.target == pytest.approx(given.target @ given.target, rel=1e-12)


def test_joined_pieces_remember_how_many_rows_they_stand_for_and_what_was_left_out() -> None:
    draw = np.random.default_rng(1)
    pieces = [Regression(draw.normal(size=(30, 2)), draw.normal(size=30), left_out=k) for k in (1, 2, 4)]
    found = None
    for one in pieces:
        found = joined(found, one)
    assert found is not None
    assert (found.size, found.left_out, len(found.target)) == (90, 7, 3)
    whole = Regression(*(np.concatenate([getattr(one, name) for one in pieces]) for name in ("design", "target")))
    assert found.height == pytest.approx(whole.height)
    np.testing.assert_allclose(found.scales, whole.scales)


@pytest.mark.parametrize("count", [100, 10_000])
@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e15])
def test_terms_that_differ_by_rounding_are_told_whatever_the_number_of_rows_and_the_unit(
    count: int, unit: float
) -> None:
    draw = np.random.default_rng(0)
    base = draw.normal(size=(count, 8))
    apart = draw.normal(size=count)
    for share, told in ((1e-13, "only 8 of 9"), (2e-12, "only 8 of 9"), (1e-10, "ok")):
        design = np.column_stack([base, base[:, 0] + share * apart])
        assert told in Regression(design, unit * (base @ np.ones(8))).status, share
