"""What a model leaves, of the dynamics and of forecasts, and how fast a motion is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.model import Model, first_fit, pace, strengths, without
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.residual import correlation_time, dynamics_share
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

OMEGA = 1.7
OSCILLATOR = library("oscillator", ["u[n]"])


def swinging(push=lambda _: 0.0, *, noise=1e-3, span=20.0, start=(1.0, 0.0)):
    """One harmonic oscillator with a push, integrated by SciPy."""
    t = np.linspace(0, span, 200)
    y = solve_ivp(
        lambda t, y: [y[1], push(t) - OMEGA**2 * y[0]], (0, span), start, t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.1
    ).y
    u, v = (part[:, None] + noise * np.random.default_rng(5).normal(size=(len(t), 1)) for part in y)
    return Samples(t, u, v, ends="free", source="swinging.csv")


def test_the_pace_of_a_harmonic_motion_is_its_angular_frequency():
    assert pace(first_fit(Model(OSCILLATOR, 2), [swinging()]).curves()) == pytest.approx(OMEGA, rel=0.02)


def test_noise_is_independent_from_sample_to_sample_and_what_a_wrong_model_leaves_is_not():
    right = first_fit(Model(OSCILLATOR, 2), [swinging()])
    wrong = first_fit(Model(library("constant", ["1"]), 2), [swinging()])
    assert correlation_time(right) == pytest.approx(1, abs=0.5)
    assert correlation_time(wrong) > 3


def test_the_strength_of_a_spring_is_that_of_its_acceleration():
    fitted = first_fit(Model(OSCILLATOR, 2), [swinging()])
    assert strengths(fitted) == pytest.approx([OMEGA**2 * np.sqrt(np.mean(swinging().u ** 2))], rel=0.01)


def test_a_trajectory_that_rests_does_not_spoil_the_share_of_the_others():
    moving, resting = swinging(), swinging(start=(0.0, 0.0), noise=1e-9)
    one = dynamics_share(first_fit(Model(OSCILLATOR, 2), [moving]))
    both = dynamics_share(first_fit(Model(OSCILLATOR, 2), [moving, resting]))
    assert both == pytest.approx(one, rel=0.5)


def test_a_pulse_that_comes_after_the_readings_is_not_foreseen_and_spoils_no_forecast():
    data = swinging(lambda t: 0.01 * np.exp(-(((t - 17.0) / 0.4) ** 2) / 2))
    found = diagnose(OSCILLATOR, 2, [data], CATALOGUE)
    assert "kick" in [placed.effect.name for placed in found.course.after.model.effects]
    # The pulse itself is in the held-out part, and nobody could have known it.
    assert found.forecast[1] == pytest.approx(found.forecast[0], rel=0.2)


def test_a_change_is_taken_out_with_its_own_coefficients():
    data = swinging(lambda t: 0.01 * np.exp(-(((t - 8.0) / 0.4) ** 2) / 2))
    whole = diagnose(OSCILLATOR, 2, [data], CATALOGUE).course.after
    assert len(whole.model.effects) == 1
    less = without(whole, 0)
    assert less.model.effects == ()
    np.testing.assert_array_equal(less.solution.state.coefficients, whole.solution.state.coefficients[:1])


def test_the_past_of_an_instant_ago_is_no_memory():
    """A delay much shorter than the motion makes a sum of the field and its derivatives, which other effects are."""
    from latticebench.diagnosis.catalogued import SHORTEST_DELAY, candidates_of
    from latticebench.diagnosis.tangent import linearise
    from latticebench.systems.effects import find

    fitted = first_fit(Model(OSCILLATOR, 2), [swinging()])
    delays = [one.placed.psi["delay"] for one in candidates_of(linearise(fitted), find("memory"))]
    assert min(delays) * OMEGA >= 0.95 * SHORTEST_DELAY
