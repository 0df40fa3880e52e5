"""E-SINDy: what the ensemble is without noise, and its inclusion probabilities by statistics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from latticebench import methods
from latticebench.methods.e_sindy import Ensemble, ESINDy, bag
from latticebench.methods.engine.regression import Regression
from latticebench.methods.method import make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples


def test_without_noise_every_model_is_stlsq() -> None:
    t = np.linspace(0, 5, 60)
    # u'' = -2 u - 0.3 v in closed form, each site with a phase of its own.
    w = np.sqrt(2 - 0.15**2)
    decay = np.exp(-0.15 * t)[:, None]
    phase = w * t[:, None] + np.array([0.0, 0.9, 2.1])
    u = decay * np.cos(phase)
    samples = Samples(t, u, -0.15 * u - decay * w * np.sin(phase))
    terms = library("lib", "u[n]; v[n]; u[n]**3; sin(v[n])-v[n]")
    ensemble = solve(make(methods.find("e-sindy"), {}), [samples], terms, 2, seed=1)
    single = solve(make(methods.find("stlsq"), {}), [samples], terms, 2, seed=1)
    np.testing.assert_allclose(ensemble.coefficients, single.coefficients, atol=1e-4)
    np.testing.assert_allclose(ensemble.coefficients, [-2, -0.3, 0, 0], atol=1e-3)
    assert ensemble.stderr is not None
    assert np.max(ensemble.stderr) < 1e-3
    assert ensemble.found["inclusion of u[n]"] == 1.0
    assert float(ensemble.found["inclusion of u[n]**3"]) < 0.6


@pytest.mark.parametrize("distance", [-1.0, 0.0, 0.7])
def test_the_inclusion_probability_is_that_of_a_bootstrap_about_the_least_squares_estimate(distance: float) -> None:
    rng = np.random.default_rng(2)
    rows, models = 400, 300
    design = rng.normal(size=(rows, 2))
    target = design @ [1.0, 0.1] + 0.3 * rng.normal(size=rows)
    estimate, *_ = np.linalg.lstsq(design, target, rcond=None)
    left = target - design @ estimate
    inverse = np.linalg.inv(design.T @ design)
    # The sandwich: the bootstrap of rows has this spread.
    spread = np.sqrt((inverse @ (design.T * left**2) @ design @ inverse)[1, 1])
    share = np.sqrt(np.mean(design[:, 1] ** 2) / np.mean(target**2))
    threshold = (estimate[1] - distance * spread) * share
    found = bag(Regression(design, target), threshold, models, 0, seed=5)
    assert found.inclusion[0] == 1.0
    expected = norm.cdf(distance)
    # Five standard errors of a share of `models`, and what the normal law leaves out.
    assert found.inclusion[1] == pytest.approx(expected, abs=5 * np.sqrt(expected * (1 - expected) / models) + 0.03)
    kept = found.coefficients[:, 1]
    assert np.std(found.coefficients[:, 0]) == pytest.approx(
        np.sqrt((inverse @ (design.T * left**2) @ design @ inverse)[0, 0]), rel=0.3
    )
    assert np.min(np.abs(kept[kept != 0])) * share >= 0.9 * threshold


def test_a_term_counts_only_where_it_was_offered() -> None:
    rng = np.random.default_rng(3)
    design = rng.normal(size=(200, 3))
    found = bag(Regression(design, design @ [1.0, -0.7, 0.0]), 0.05, 60, 1, seed=4)
    assert np.all(np.sum(found.offered, axis=1) == 2)
    assert np.all(np.sum(found.offered, axis=0) < 60)
    assert list(found.inclusion[:2]) == [1.0, 1.0]
    # Where a true term is missing the third may stand in for it by chance; where both are there it goes.
    whole = found.offered[:, 0] & ~found.offered[:, 1]
    assert np.any(whole)
    without = found.offered[:, 2] & found.offered[:, 0] & found.offered[:, 1]
    assert not np.any(without)


def test_settings_out_of_range_are_refused() -> None:
    for given in ({"models": 1}, {"inclusion": 0.0}, {"thresholds": ()}, {"dropped": -1}):
        with pytest.raises(InputError, match="e-sindy"):
            make(ESINDy, given)


def test_the_bags_of_rows_are_drawn_apart_from_those_of_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[int, int]] = []

    def watched(regression: Regression, threshold: float, models: int, dropped: int, seed: int) -> Ensemble:
        drawn.append((dropped, seed))
        return bag(regression, threshold, models, dropped, seed)

    monkeypatch.setattr("latticebench.methods.e_sindy.bag", watched)
    rng = np.random.default_rng(3)
    design = rng.normal(size=(50, 3))
    ESINDy(dropped=1, models=5).bagged(Regression(design, design @ [1.0, -0.7, 0.0]), 0.05, seed=4)
    assert drawn == [(1, 4), (0, 5)]
