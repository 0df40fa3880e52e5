"""The network that is solved for: what it finds, and what its settings do."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.methods import pielm
from latticebench.methods.engine.networks.members import member_draws
from latticebench.methods.method import Skipped, make, solve
from latticebench.methods.pielm import PIELM
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate

SMALL = {"width": 20, "collocation": 61}


def chain(sites: int, ends: str = "unknown", *, is_complex: bool = False) -> Samples:
    t = np.linspace(0.5, 2.5, 15)
    u = np.sin(t[:, None] + 0.7 * np.arange(sites)) + 0.2
    v = np.cos(1.3 * t[:, None] - 0.4 * np.arange(sites))
    if is_complex:
        return Samples(t, u + 1j * v, ends=ends)  # type: ignore[arg-type]
    return Samples(t, u, v, ends=ends)  # type: ignore[arg-type]


def oscillators(sites: int = 3) -> tuple[Samples, np.ndarray]:
    """Uncoupled oscillators u'' = -2 u, exact in closed form."""
    t = np.linspace(0, 4, 40)
    amplitude, phase, w = 1 + 0.3 * np.arange(sites), 0.9 * np.arange(sites), np.sqrt(2)
    u = amplitude * np.cos(w * t[:, None] + phase)
    return Samples(t, u, -w * amplitude * np.sin(w * t[:, None] + phase)), np.array([-2.0, 0.0])


def test_an_oscillator_is_found_to_many_digits():
    samples, truth = oscillators()
    fit = solve(PIELM(), [samples], library("lib", "u[n]; u[n]**3"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, truth, atol=1e-5)
    assert fit.status == "ok"
    assert fit.history is not None
    np.testing.assert_array_equal(fit.history.coefficients[-1], fit.coefficients)


def test_phi4_without_noise_and_with_one_per_cent_is_found():
    system = systems.find("phi4")
    clean = simulate(system, sites=9, times=sample_times(40, 8.0))
    candidates = system.library("lib2")
    truth = clean.truth(candidates)
    assert truth is not None
    for samples, bound in ((clean, 1e-4), (observe(clean, np.random.default_rng(0), noise=0.01), 3e-2)):
        fit = solve(PIELM(width=60), [samples], candidates, 2, 0)
        assert np.linalg.norm(fit.coefficients - truth) <= bound * np.linalg.norm(truth)


def test_standard_errors_have_the_size_of_the_errors():
    samples, truth = oscillators()
    assert samples.v is not None
    shares = []
    for seed in range(12):
        draw = np.random.default_rng(seed)
        noisy = Samples(
            samples.t,
            samples.u + 0.02 * draw.normal(size=samples.u.shape),
            samples.v + 0.02 * draw.normal(size=samples.u.shape),
        )
        fit = solve(PIELM(**SMALL), [noisy], library("lib", "u[n]; u[n]**3"), 2, seed)
        assert fit.stderr is not None
        shares.append((fit.coefficients - truth) / fit.stderr)
    assert 0.4 < np.sqrt(np.mean(np.square(shares))) < 2.5


def test_missing_values_and_velocities_that_were_not_observed_are_taken():
    samples, truth = oscillators()
    u = samples.u.copy()
    u[np.random.default_rng(4).uniform(size=u.shape) < 0.2] = np.nan
    fit = solve(PIELM(**SMALL), [Samples(samples.t, u)], library("lib", "u[n]; u[n]**3"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, truth, atol=1e-2)


def test_a_measured_input_and_two_trajectories_are_taken():
    # u'' = -4 u + f with f = cos(t).
    t = np.linspace(0, 6, 61)
    data = [
        Samples(t[:length], (np.cos(t) / 3 + b * np.cos(2 * t))[:length, None], f=np.cos(t)[:length, None])
        for b, length in ((0.2, 61), (-0.5, 45))
    ]
    fit = solve(PIELM(width=40), data, library("lib", "u[n]; f[n]"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, [-4, 1], atol=1e-2)


def test_the_same_seed_gives_the_same_digits():
    samples, _ = oscillators()
    first, again = (solve(PIELM(**SMALL), [samples], library("lib", "u[n]"), 2, 5) for _ in range(2))
    np.testing.assert_array_equal(first.coefficients, again.coefficients)


def test_too_many_unknowns_are_a_reason_to_skip():
    with pytest.raises(Skipped, match="width"):
        solve(PIELM(), [chain(400)], library("lib", "u[n]"), 2, 0)


@pytest.mark.parametrize(("name", "value"), [("width", 0), ("weights", []), ("tolerance", -1.0), ("members", 0)])
def test_unsound_settings_are_named(name, value):
    with pytest.raises(InputError, match=name):
        make(PIELM, {name: value})


def noisy(samples: Samples, sigma: float, seed: int) -> Samples:
    assert samples.v is not None
    draw = np.random.default_rng(seed)
    u, v = (field + sigma * draw.normal(size=field.shape) for field in (samples.u, samples.v))
    return Samples(samples.t, u, v)


def gappy(samples: Samples) -> Samples:
    u = samples.u.copy()
    u[np.random.default_rng(4).uniform(size=u.shape) < 0.2] = np.nan
    return Samples(samples.t, u)


def test_one_network_on_the_processor_keeps_its_numbers():
    samples, _ = oscillators()
    kept = [
        (gappy(samples), [-2.0081096628073265, 0.00325133699155257], [0.18382252093121895, 0.1096253522903831]),
        (
            noisy(samples, 0.02, 1),
            [-2.0097133029221546, -8.2634476381706471e-05],
            [0.06417826153721297, 0.03833170782768845],
        ),
    ]
    for data, coefficients, stderr in kept:
        fit = solve(PIELM(**SMALL), [data], library("lib", "u[n]; u[n]**3"), 2, 0)
        np.testing.assert_allclose(fit.coefficients, coefficients, rtol=1e-6, atol=1e-7)
        assert fit.stderr is not None
        np.testing.assert_allclose(fit.stderr, stderr, rtol=1e-6)
        assert set(fit.found) == {"weight", "noise"}


DATA = {
    "exact": ([oscillators()[0]], "u[n]; u[n]**3", 2),
    "noisy": ([noisy(oscillators()[0], 0.02, 3)], "u[n]; u[n]**3", 2),
    "missing values, two trajectories": ([gappy(oscillators()[0]), oscillators(2)[0]], "u[n]; u[n]**3", 2),
    "complex, periodic": ([chain(4, "periodic", is_complex=True)], "i*u[n]; u[n+1]; abs(u[n])**2*u[n]", 1),
    "a term that is a number": ([chain(3, "free")], "u[n]; 1; v[n]", 2),
}


@pytest.mark.parametrize("name", DATA)
@pytest.mark.parametrize("members", [1, 3])
def test_torch_on_the_processor_agrees_with_numpy_for_one_network_and_for_a_batch(name, members):
    pytest.importorskip("torch")
    data, texts, order = DATA[name]
    candidates = library("lib", texts)
    plain, torch = (
        solve(PIELM(**SMALL, members=members, device=device), data, candidates, order, 5) for device in ("cpu", "cpu:0")
    )
    scale = np.max(np.abs(plain.coefficients))
    np.testing.assert_allclose(torch.coefficients, plain.coefficients, rtol=1e-7, atol=1e-8 * scale)
    assert plain.stderr is not None
    np.testing.assert_allclose(torch.stderr, plain.stderr, rtol=1e-5)
    assert torch.found.keys() == plain.found.keys()
    for key, value in plain.found.items():
        assert torch.found[key] == pytest.approx(value, rel=1e-4, abs=1e-8 * scale), key


def test_of_several_members_the_best_is_the_fit_and_their_spread_is_that_of_the_single_ones(monkeypatch):
    data, candidates = [noisy(oscillators()[0], 0.02, 3)], library("lib", "u[n]; u[n]**3")
    whole = solve(PIELM(**SMALL, members=3), data, candidates, 2, 5)
    alone = []
    for draw in range(3):
        monkeypatch.setattr(pielm, "member_draws", lambda seed, _members, k=draw: member_draws(seed, 3)[k : k + 1])
        alone.append(solve(PIELM(**SMALL), data, candidates, 2, 5))
    best = min(alone, key=lambda fit: fit.found["noise"])
    assert np.array_equal(whole.coefficients, best.coefficients)
    assert whole.found["noise"] == best.found["noise"]
    spread = np.std([fit.coefficients for fit in alone], axis=0, ddof=1)
    found = [whole.found[f"spread of {text}"] for text in candidates.texts]
    np.testing.assert_allclose(found, spread, rtol=1e-12)


def test_the_name_that_it_had_is_refused_with_the_one_that_it_has() -> None:
    with pytest.raises(InputError, match="'pinn-vp' is called 'pielm' now; write pielm"):
        methods.find("pinn-vp")
