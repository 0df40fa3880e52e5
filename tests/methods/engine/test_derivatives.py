"""Derivatives against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.derivatives import KINDS, differentiate
from latticebench.systems.errors import InputError

T = np.linspace(0, 6, 61)
FIELD = np.column_stack([np.sin(2 * T), np.cos(T)])
FIRST = np.column_stack([2 * np.cos(2 * T), -np.sin(T)])
SECOND = np.column_stack([-4 * np.sin(2 * T), -np.cos(T)])


@pytest.mark.parametrize(
    ("kind", "options", "tolerance"),
    [
        ("smoothing-spline", None, 3e-3),
        ("spline", None, 1e-4),
        ("FiniteDifference", None, 0.03),
        ("FiniteDifference", {"order": 4}, 2e-3),
        ("SmoothedFiniteDifference", None, 0.4),
        ("savitzky_golay", {"left": 0.5, "right": 0.5, "order": 3}, 0.05),
    ],
)
def test_each_way_differentiates_sines(kind: str, options: dict[str, float] | None, tolerance: float) -> None:
    found = differentiate(T, FIELD, kind, options)
    assert np.max(np.abs(found.first - FIRST)) < tolerance
    inner = slice(5, -5)
    assert np.max(np.abs(found.second - SECOND)[inner]) < 10 * tolerance


def test_the_interpolating_spline_converges_with_order_five_or_better() -> None:
    def error(count: int) -> float:
        t = np.linspace(0, 6, count)
        found = differentiate(t, np.sin(2 * t)[:, None], "spline")
        return float(np.max(np.abs(found.first[:, 0] - 2 * np.cos(2 * t))))

    assert np.log2(error(41) / error(81)) > 4.5


def test_the_smoothing_spline_chooses_its_weight_from_the_noise() -> None:
    rng = np.random.default_rng(3)
    noisy = FIELD + 0.02 * rng.normal(size=FIELD.shape)
    smooth = differentiate(T, noisy, "smoothing-spline")
    rough = differentiate(T, noisy, "spline")
    assert np.std(smooth.value - FIELD) < 0.7 * 0.02
    assert np.std(smooth.second - SECOND) < 0.1 * np.std(rough.second - SECOND)


def test_the_unit_of_time_does_not_matter() -> None:
    noisy = FIELD + 0.02 * np.random.default_rng(3).normal(size=FIELD.shape)
    once, slow = differentiate(T, noisy, "smoothing-spline"), differentiate(1000 * T, noisy, "smoothing-spline")
    np.testing.assert_allclose(slow.first * 1000, once.first, rtol=1e-5, atol=1e-6)


def test_a_complex_field_is_differentiated_part_by_part() -> None:
    together = differentiate(T, FIELD[:, :1] + 1j * FIELD[:, 1:], "spline")
    apart = differentiate(T, FIELD, "spline")
    np.testing.assert_allclose(together.first[:, 0], apart.first[:, 0] + 1j * apart.first[:, 1])


def test_gaps_stay_gaps_and_the_rest_is_differentiated() -> None:
    gappy = FIELD.copy()
    gappy[[7, 20, 21], 0] = np.nan
    found = differentiate(T, gappy, "spline")
    assert np.array_equal(np.isnan(found.first), np.isnan(gappy))
    assert np.nanmax(np.abs(found.first - FIRST)) < 1e-2


def test_a_long_record_is_smoothed_with_a_bounded_number_of_coefficients() -> None:
    t = np.linspace(0, 30, 5000)
    noisy = np.sin(3 * t) + 0.01 * np.random.default_rng(0).normal(size=t.size)
    found = differentiate(t, noisy[:, None], "smoothing-spline")
    assert np.std(found.first[:, 0] - 3 * np.cos(3 * t)) < 0.05


def test_wrong_ways_and_options_are_told() -> None:
    with pytest.raises(InputError, match="did you mean 'FiniteDifference'"):
        differentiate(T, FIELD, "FiniteDiference")
    with pytest.raises(InputError, match="takes no options"):
        differentiate(T, FIELD, "spline", {"order": 2})
    with pytest.raises(InputError, match="at least 6 samples"):
        differentiate(T[:4], FIELD[:4], "spline")
    with pytest.raises(InputError, match="savitzky_golay"):
        differentiate(T, FIELD, "savitzky_golay", {"nonsense": 2})


def test_the_options_stay_as_they_were_given() -> None:
    options = {"smoother_kws": {"window_length": 7, "polyorder": 3}}
    differentiate(T, FIELD, "SmoothedFiniteDifference", options)
    assert options == {"smoother_kws": {"window_length": 7, "polyorder": 3}}


def test_every_kind_of_the_derivative_package_is_known() -> None:
    from derivative.differentiation import methods

    assert set(KINDS) <= set(methods)


def test_noise_is_smoothed_beside_gaps_as_elsewhere() -> None:
    noisy = FIELD + 0.02 * np.random.default_rng(3).normal(size=FIELD.shape)
    noisy[[7, 20, 21], 0] = np.nan
    smooth, rough = (differentiate(T, noisy, kind) for kind in ("smoothing-spline", "spline"))
    assert np.nanstd(smooth.second - SECOND) < 0.1 * np.nanstd(rough.second - SECOND)
    np.testing.assert_allclose(rough.value, noisy, rtol=1e-12)
