"""The state of a trajectory as splines: its noise and its uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods.engine.spline_state import estimate_state
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate


@pytest.mark.parametrize("noise", [0.001, 0.05])
def test_the_noise_is_estimated_to_a_twentieth(noise: float) -> None:
    clean = simulate(systems.find("phi4"), times=sample_times(401))
    state = estimate_state(observe(clean, np.random.default_rng(0), noise=noise).observed(), 2)
    for found, field in zip(state.noise, (clean.u, clean.v), strict=True):
        assert field is not None
        assert found == pytest.approx(noise * np.std(field), rel=0.05)


def test_a_state_with_gaps_is_uncertain_where_nothing_was_seen() -> None:
    t = sample_times(100)
    rng = np.random.default_rng(0)
    u = (np.sin(t) + 0.01 * rng.normal(size=100))[:, None]
    u[40:60] = np.nan
    state = estimate_state(Samples(t, u), 2)
    in_the_gap, outside = np.linalg.norm(state.basis(np.array([5.0, 2.5]), 0) @ state.factors[0], axis=1)
    assert in_the_gap > 5 * outside


def test_all_channels_have_a_spline_where_the_samples_bear_no_finer_knots():
    clean = simulate(systems.find("dnls"), sites=15, times=sample_times(40, 8.0))
    seen = observe(clean, np.random.default_rng(0), noise=0.01, missing=0.1).observed()
    u = np.where(np.isnan(seen.u), complex(np.nan, np.nan), seen.u)
    state = estimate_state(replace(seen, u=u), 1)
    assert len(state.seen) == len(state.factors) == 30
