"""What rounding adds to readings: its mean, and a diagnosis that takes it away."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.rounding import expected
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

T, STEP = np.linspace(0, 60, 1000), 0.09
DECLARED = library("oscillator", "u[n]")


def motion(damping=0.0):
    """Return an oscillator's motion, u'' = -u - damping * u'."""
    rate = np.sqrt(1 - damping**2 / 4)
    return np.exp(-damping * T / 2) * np.cos(rate * T + 0.3)


def readings(u, seed=1):
    """Return readings in steps, with noise of a tenth of one."""
    noise = np.random.default_rng(seed).normal(size=len(T)) * STEP / 10
    return Samples(T, (STEP * np.round((u + noise) / STEP))[:, None])


@pytest.mark.parametrize("spread", [0.05, 0.1, 0.3])
def test_the_mean_error_of_rounding_is_that_of_many_readings(spread):
    draw = np.random.default_rng(1)
    for x in (-3.13, 0.0, 0.2, 0.45, 1.5, 7.77):
        many = x + spread * draw.normal(size=200_000)
        # Of a mean of 200 000 errors below 1/2.
        assert expected(np.array(x), 1.0, spread) == pytest.approx(np.mean(np.round(many)) - x, abs=6e-3)


def test_the_error_has_the_unit_of_the_step():
    x = np.linspace(-1, 1, 50)
    np.testing.assert_allclose(expected(3 * x, 3 * 0.2, 0.1), 3 * expected(x, 0.2, 0.1), atol=1e-12)


def test_a_regular_motion_in_coarse_steps_lacks_nothing():
    for seed in (1, 2):
        samples = readings(motion(), seed)
        found = diagnose(DECLARED, 2, [samples], CATALOGUE)
        assert found.verdict == "nothing missing"
        assert found.rms[1] < 0.9 * np.std(samples.u[:, 0] - motion())


def test_an_effect_below_a_step_is_found_beside_rounding():
    friction = 1e-3
    assert np.max(np.abs(motion(friction) - motion())) < STEP / 2
    found = diagnose(DECLARED, 2, [readings(motion(friction))], CATALOGUE)
    (one,) = found.findings
    assert found.verdict == "explained"
    assert "damping" in (one.name, *one.alternatives)
