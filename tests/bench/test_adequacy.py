"""A fit that does not describe the readings says so, and one that does is left in peace; none looks at the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench import methods
from latticebench.bench import adequacy as judge
from latticebench.bench.adequacy import adequacy
from latticebench.bench.fitting import FitCase, samples
from latticebench.bench.noise import left_by, of_sensors
from latticebench.methods.method import Fit, make, solve
from latticebench.systems import find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate

PENDULA = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")


def pendula(*, defect=0.0, noise=2e-3, scale=1.0):
    """Three coupled pendula, 12 periods, written out with plain loops."""
    stiffness = [25.0, 25.0 - defect, 25.0]

    def rate(_, y):
        forces = []
        for n in range(3):
            pulls = sum(y[m] - y[n] for m in (n - 1, n + 1) if 0 <= m < 3)
            forces.append(4.0 * pulls - stiffness[n] * np.sin(y[n]))
        return [*y[3:], *forces]

    t = np.arange(0, 15, 0.05)
    u = solve_ivp(rate, (0, 15), [0.5, -0.3, 0.2, 0, 0, 0], t_eval=t, rtol=1e-9, atol=1e-11).y[:3].T
    noisy = u + noise * np.random.default_rng(3).standard_normal(u.shape)
    return Samples(t, scale * noisy, ends="free")


def fitted(data, method, **given):
    return solve(make(methods.find(method), given), [data], PENDULA, 2, 1)


def test_degrees_in_a_sine_are_told_and_radians_are_not():
    degrees = pendula(scale=180 / np.pi)
    quality = adequacy([degrees], fitted(degrees, "least-squares"))
    assert not quality.fits
    assert "the equation does not fit" in quality.warnings[0]
    assert "diagnose" in quality.warnings[0]
    assert quality.work > 0.2
    radians = pendula()
    quality = adequacy([radians], fitted(radians, "least-squares"))
    assert (quality.fits, quality.warnings) == (True, ())
    assert quality.r2 > 0.99


def test_a_network_in_a_local_minimum_is_told_whatever_it_says_of_itself():
    # So few hidden units cannot follow twelve periods.
    data = pendula()
    found = fitted(data, "pielm", width=12)
    quality = adequacy([data], found)
    assert not quality.fits
    assert quality.warnings


@pytest.mark.parametrize("method", ["stlsq", "sr3", "least-squares"])
def test_terms_that_cancel_each_other_are_told_where_a_method_gives_no_standard_errors(method):
    data = simulate(find("phi4"), sites=21, times=sample_times(50, 10.0))
    data = observe(data, np.random.default_rng(1), noise=0.01).observed()
    fits = {
        name: adequacy([data], solve(make(methods.find(method), {}), [data], find(system).library(name), 2, 1))
        for system, name in (("sine-gordon", "sines"), ("phi4", "lib2"))
    }
    assert not fits["sines"].fits
    assert {"sin(u[n])", "sin(2*u[n])"} <= set(fits["sines"].unknown)
    assert "do not determine the coefficients" in fits["sines"].warnings[0]
    assert fits["lib2"].fits


def test_a_whole_trajectory_with_the_wrong_equation_is_told_that_its_standard_errors_mean_nothing():
    data = pendula(defect=3.0)
    found = fitted(data, "trajectory")
    assert found.stderr is not None
    quality = adequacy([data], found)
    assert not quality.fits
    assert quality.times > 3
    assert any("standard errors" in line for line in quality.warnings)
    right = pendula()
    assert adequacy([right], fitted(right, "trajectory")).fits


@pytest.mark.parametrize("name", ["phi4", "dnls"])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_the_right_coefficients_fit_at_any_noise_and_half_of_one_is_told_where_it_can_be_seen(name, noise):
    system = find(name)
    equation = system.library("equation")
    about = {"library": "equation", "label": "", "method": "", "memory_limit": 2**30, "samples": 50, "noise": noise}
    data = samples(FitCase(system=name, seed=2, **about), Path())
    truth = data[0].truth(equation)
    wrong = truth * np.r_[0.5, np.ones(len(truth) - 1)]

    def fits(coefficients):
        return adequacy(data, Fit("any", equation, system.order, coefficients, 0.0)).fits

    assert fits(truth)
    assert not fits(wrong) or noise == 0.1


@pytest.mark.parametrize("name", ["phi4", "sine-gordon", "ginzburg-landau"])
def test_readings_without_noise_do_not_contradict_the_equation_that_made_them(name):
    system = find(name)
    equation = system.library("equation")
    data = [simulate(system, times=sample_times(50, 10.0)).observed()]
    found = solve(make(methods.find("trajectory"), {}), data, equation, system.order, 1)
    quality = adequacy(data, found)
    assert quality.fits, quality.warnings
    assert left_by(data, found).warning == ()
    fewer = library("fewer", equation.texts[:-1])
    assert not adequacy(data, solve(make(methods.find("trajectory"), {}), data, fewer, system.order, 1)).fits


def test_what_readings_without_noise_say_of_it_is_that_there_is_none():
    t = np.linspace(0.0, 20.0, 400)
    data = [Samples(t, np.column_stack([np.cos(t), np.sin(t)]), ends="free")]
    found = solve(make(methods.find("trajectory"), {}), data, library("one", "u[n]"), 2, 1)
    assert "the readings have no noise" in adequacy(data, found).in_words


def test_a_motion_that_runs_away_and_a_sensor_that_rests_are_no_obstacle():
    data = pendula()
    rests = Samples(data.t, np.column_stack([data.u, np.full(len(data.t), 7.0)]), ends="free")
    quality = adequacy([rests], Fit("any", PENDULA, 2, np.array([1.0, 500.0]), 0.0))
    assert not quality.fits
    assert np.isfinite(quality.work)


def test_a_sensor_that_always_reads_the_same_shows_no_noise_to_measure_by():
    data = pendula()
    dead = Samples(data.t, np.column_stack([data.u[:, :1], np.full(len(data.t), 0.2)]), ends="free")
    shown, silent = of_sensors(dead.t, dead.u)
    assert shown[0] == of_sensors(data.t, data.u)[0][0]
    assert np.isnan(shown[1])
    assert not silent
    assert not np.isnan(of_sensors(dead.t, dead.u[:, 1:])[0]).any()


def long_chain():
    clean = simulate(find("phi4"), sites=60, times=sample_times(40, 4.0), variation=np.random.default_rng(4))
    return replace(observe(clean, np.random.default_rng(1), noise=0.01).observed(), ends="free")


def test_a_long_chain_is_judged_by_windows_that_a_seed_chooses(monkeypatch):
    seen, terms = long_chain(), find("phi4").library("lib2")
    right = solve(make(methods.find("least-squares"), {}), [seen], terms, 2, 1)
    wrong = replace(right, coefficients=right.coefficients * [1, 1, 1, 0.3])
    whole = adequacy([seen], right)
    followed, smooth = [], judge.smooth
    monkeypatch.setattr(judge, "WIDE", 40)
    monkeypatch.setattr(judge, "WINDOW", 20)
    monkeypatch.setattr(judge, "smooth", lambda one, order: followed.append(one.sites) or smooth(one, order))
    found = adequacy([seen], right)
    assert followed == [22] * judge.PLACES
    assert found == adequacy([seen], right)
    assert found.fits
    assert found.r2 == pytest.approx(whole.r2, abs=0.02)
    assert not adequacy([seen], wrong).fits


def test_a_motion_is_judged_where_the_windows_are(monkeypatch):
    seen = long_chain()
    fit = solve(make(methods.find("trajectory"), {}), [seen], find("phi4").library("lib2"), 2, 1)
    monkeypatch.setattr(judge, "WIDE", 40)
    monkeypatch.setattr(judge, "WINDOW", 20)
    assert 0.8 < adequacy([seen], fit).times < 1.2
