"""The trained network: what it finds, and what its settings do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.published import read_head
from latticebench.methods.engine.inputs import inputs
from latticebench.methods.method import make, settings, solve
from latticebench.methods.pielm import PIELM
from latticebench.methods.pinn import PINN
from latticebench.methods.pinn_gn import PINNGaussNewton
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import simulate

FEW = {"layers": 2, "width": 12, "collocation": 41}


def oscillators(sites: int = 3) -> tuple[Samples, np.ndarray]:
    """Uncoupled oscillators u'' = -2 u with different amplitudes and phases: exact in closed form."""
    t = np.linspace(0, 4, 40)
    amplitude, phase = 1 + 0.3 * np.arange(sites), 0.9 * np.arange(sites)
    w = np.sqrt(2)
    u = amplitude * np.cos(w * t[:, None] + phase)
    return Samples(t, u, -w * amplitude * np.sin(w * t[:, None] + phase)), np.array([-2.0, 0.0])


def test_the_network_is_the_papers_and_is_trained_as_the_published_tables_say():
    made = read_head(Path(__file__).parents[2] / "results" / "default" / "cases.csv")["settings"]
    (told,) = [one for one in made.split("; ") if one.startswith("pinn pinn,")]
    assert told == "pinn pinn, " + ", ".join(f"{name}={value}" for name, value in settings(PINN).items())
    assert "layers=3, width=40" in told


def test_torch_is_loaded_for_a_device_alone():
    assert PINN().abilities.loads == ()
    assert PINN(device="cpu:0").abilities.loads == ("torch",)


def test_a_short_fit_finds_an_oscillator():
    samples, truth = oscillators()
    fit = solve(PINN(**FEW, adam_steps=300, lbfgs_steps=1500), [samples], library("lib", "u[n]; u[n]**3"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, truth, atol=5e-3)
    assert fit.residual < 0.01
    history = fit.history
    assert history is not None
    assert np.all(np.diff(history.step) > 0)
    assert 300 < history.step[-1] <= 1800
    assert np.all(np.diff(history.seconds) >= 0)
    assert history.coefficients.shape == (len(history.step), 2)
    np.testing.assert_array_equal(history.coefficients[0], 0)
    np.testing.assert_array_equal(history.coefficients[-1], fit.coefficients)


def test_the_velocity_need_not_be_observed():
    samples, truth = oscillators()
    blind = Samples(samples.t, samples.u)
    fit = solve(PINN(**FEW, adam_steps=300, lbfgs_steps=1500), [blind], library("lib", "u[n]; u[n]**3"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, truth, atol=2e-2)


def test_missing_values_are_left_out():
    samples, truth = oscillators()
    u = samples.u.copy()
    u[np.random.default_rng(4).uniform(size=u.shape) < 0.2] = np.nan
    fit = solve(
        PINN(**FEW, adam_steps=300, lbfgs_steps=1500),
        [Samples(samples.t, u, samples.v)],
        library("lib", "u[n]; u[n]**3"),
        2,
        0,
    )
    np.testing.assert_allclose(fit.coefficients, truth, atol=1e-2)


def test_the_same_seed_gives_the_same_digits_and_another_seed_does_not():
    samples, _ = oscillators()
    method = PINN(**FEW, adam_steps=60, lbfgs_steps=60)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first, again, other = (solve(method, [samples], library("lib", "u[n]"), 2, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.coefficients, again.coefficients)
    assert first.coefficients[0] != other.coefficients[0]
    np.testing.assert_array_equal(state, np.random.get_state()[1])  # noqa: NPY002


def test_mirrored_samples_keep_even_terms_out():
    # One sided motion: u and u^2 rise and fall together, so that samples of +u alone hardly tell them apart.
    t = np.linspace(0, 4, 40)
    u = 1 + 0.3 * np.cos(np.sqrt(2) * t)[:, None]
    v = -0.3 * np.sqrt(2) * np.sin(np.sqrt(2) * t)[:, None]
    samples, candidates = Samples(t, u, v), library("lib", "u[n]; u[n]**2; u[n]**3; u[n]**4")
    settings = FEW | {"adam_steps": 300, "lbfgs_steps": 700}
    plain = solve(PINN(**settings), [samples], candidates, 2, 0).coefficients
    mirrored = solve(PINN(**settings, mirror=True), [samples], candidates, 2, 0).coefficients
    assert np.max(np.abs(mirrored[[1, 3]])) < 0.02 * np.max(np.abs(mirrored))
    assert np.max(np.abs(plain[[1, 3]])) > 5 * np.max(np.abs(mirrored[[1, 3]]))


def test_a_measured_input_is_used_at_every_collocation_time():
    # u'' = -4 u + f with f = cos(t) has the solution cos(t)/3.
    t = np.linspace(0, 6, 31)
    samples = Samples(t, np.cos(t)[:, None] / 3 + 0.2 * np.cos(2 * t)[:, None], f=np.cos(t)[:, None])
    fit = solve(PINN(**FEW, adam_steps=300, lbfgs_steps=2500), [samples], library("lib", "u[n]; f[n]"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, [-4, 1], atol=0.05)
    fine = np.linspace(0, 6, 101)
    np.testing.assert_allclose(inputs(samples, fine)[:, 0], np.cos(fine), atol=1e-3)


def test_two_trajectories_of_different_length_share_their_coefficients():
    samples, truth = oscillators()
    later = Samples(samples.t[:25] + 3, 1.7 * samples.u[5:30], None)
    assert samples.v is not None
    fit = solve(
        PINN(**FEW, adam_steps=300, lbfgs_steps=1500), [Samples(samples.t, samples.u), later],
        library("lib", "u[n]; u[n]**3"), 2, 0,
    )  # fmt: skip
    np.testing.assert_allclose(fit.coefficients, truth, atol=2e-2)


def test_units_of_field_and_time_do_not_matter():
    samples, _ = oscillators()
    candidates = library("lib", "u[n]; u[n]**3")
    method = PINN(**FEW, adam_steps=20, lbfgs_steps=0)
    plain = solve(method, [samples], candidates, 2, 0).coefficients
    # Lengths in millimetres, times in minutes: [1/time^2] and [1/(time length)^2].
    assert samples.v is not None
    other = Samples(samples.t / 60, samples.u * 1e3, samples.v * 6e4)
    scaled = solve(method, [other], candidates, 2, 0).coefficients
    np.testing.assert_allclose(scaled, plain * np.array([3600, 3600e-6]), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lib1", "lib2", "lib3"])
def test_the_defaults_find_phi4(name):
    system = systems.find("phi4")
    fit = solve(PINN(), [simulate(system)], system.library(name), 2, 0)
    truth = simulate(system).truth(system.library(name))
    assert truth is not None
    assert np.linalg.norm(fit.coefficients - truth) <= 5e-2 * np.linalg.norm(truth)


@pytest.mark.parametrize(
    ("name", "value"), [("layers", 0), ("collocation", 1), ("data_weight", 0.0), ("learning_rate", np.inf)]
)
def test_unsound_settings_are_named(name, value):
    with pytest.raises(InputError, match=name):
        make(PINN, {name: value})


@pytest.mark.parametrize("kind", [PINN, PIELM, PINNGaussNewton])
@pytest.mark.parametrize("device", ["nonesuch", "cuda"])
def test_a_device_that_is_not_there_is_told_in_one_line(kind, device):
    torch = pytest.importorskip("torch")
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("it is there")
    samples, _ = oscillators()
    with pytest.raises(InputError, match=f"'{device}'.*use cpu") as caught:
        solve(kind(device=device), [samples], library("lib", "u[n]"), 2, 0)
    assert "\n" not in str(caught.value)


def test_one_network_on_the_processor_keeps_its_numbers():
    samples, _ = oscillators()
    # Few steps, so that round-off has not grown.
    kept = {0: [-1.36435710869814, -0.3619149282486815], 1: [-2.383709343616671, 0.6031578967491639]}
    for seed, coefficients in kept.items():
        method = PINN(**FEW, adam_steps=40, lbfgs_steps=20)
        fit = solve(method, [samples], library("lib", "u[n]; u[n]**3"), 2, seed)
        np.testing.assert_allclose(fit.coefficients, coefficients, rtol=1e-6)
        assert set(fit.found) == {"loss"}


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_of_several_members_the_best_is_the_fit_and_their_spread_is_told(device):
    samples, _ = oscillators()
    candidates = library("lib", "u[n]; u[n]**3")
    method = PINN(**FEW, adam_steps=100, lbfgs_steps=100, members=4, device=device)
    fit, again = (solve(method, [samples], candidates, 2, 0) for _ in range(2))
    assert np.array_equal(fit.coefficients, again.coefficients)
    assert fit.found["members"] == 4
    assert float(fit.found["spread of u[n]"]) > 0
    assert fit.history is not None
    np.testing.assert_array_equal(fit.history.coefficients[-1], fit.coefficients)
    assert fit.history.loss[-1] == fit.found["loss"]
    # Adam leaves each member to itself, so that a further one can only lower the least loss.
    two, four = (
        solve(PINN(**FEW, adam_steps=100, lbfgs_steps=0, members=count, device=device), [samples], candidates, 2, 0)
        for count in (2, 4)
    )
    assert float(four.found["loss"]) <= float(two.found["loss"]) * (1 + 1e-6)
