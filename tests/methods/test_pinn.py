from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods.method import make, solve
from latticebench.methods.pinn import (
    PINN,
    Problem,
    best_member,
    columns,
    contracted,
    forward,
    initial_weights,
    inputs,
    lockstep,
    member_draws,
    power,
    scales,
    shapes,
    spread,
    workspace,
)
from latticebench.methods.pinn_vp import PINNVP
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import sample_times, simulate

FEW = {"layers": 2, "width": 12, "collocation": 41}


def chain(sites: int = 7, ends: str = "unknown", *, is_complex: bool = False, forced: bool = False) -> Samples:
    """Smooth made-up motion, with a velocity that is not the field's, so that every residual differs from zero."""
    t = np.linspace(0.5, 2.5, 12)
    n = np.arange(sites)
    u = np.sin(t[:, None] + 0.7 * n) + 0.3 * n
    v = np.cos(1.3 * t[:, None] - 0.4 * n)
    if is_complex:
        return Samples(t, u + 1j * v, ends=ends)  # type: ignore[arg-type]
    return Samples(t, u, v, np.cos(2 * t)[:, None] + 0 * u if forced else None, ends=ends)  # type: ignore[arg-type]


def problem(samples: Samples, candidates: Library, order: int, *, mirror: bool = False) -> Problem:
    sheets = [samples, samples.mirrored()] if mirror else [samples]
    return Problem(sheets, candidates, order, scales([samples], candidates, order), PINN(**FEW, mirror=mirror), 1.0)


def oscillators(sites: int = 3) -> tuple[Samples, np.ndarray]:
    """Uncoupled oscillators u'' = -2 u with different amplitudes and phases: exact in closed form."""
    t = np.linspace(0, 4, 40)
    amplitude, phase = 1 + 0.3 * np.arange(sites), 0.9 * np.arange(sites)
    w = np.sqrt(2)
    u = amplitude * np.cos(w * t[:, None] + phase)
    return Samples(t, u, -w * amplitude * np.sin(w * t[:, None] + phase)), np.array([-2.0, 0.0])


def test_the_tangent_is_the_derivative_that_torch_finds_by_forward_mode():
    torch = pytest.importorskip("torch")
    form = shapes(3, 9, 5)
    weights = initial_weights(form, 3.0, np.random.default_rng(1)) + 0.1
    pieces = np.split(weights, np.cumsum([a * b for a, b in form])[:-1])
    layers = [piece.reshape(shape) for piece, shape in zip(pieces, form, strict=True)]
    x = np.linspace(-1, 1, 11)[:, None]
    out = forward(layers, x, workspace(form, 11, 8, lambda a: a), np)
    tensors = [torch.from_numpy(layer) for layer in layers]

    def network(time):
        h = time
        for layer in tensors[:-1]:
            h = torch.tanh(h @ layer[:-1] + layer[-1])
        return h @ tensors[-1][:-1] + tensors[-1][-1]

    value, tangent = torch.func.jvp(network, (torch.from_numpy(x),), (torch.ones(11, 1, dtype=torch.float64),))
    np.testing.assert_allclose(out[:11], value.numpy(), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(out[11:], tangent.numpy()[:8], rtol=1e-12, atol=1e-13)


CASES = {
    "interior sites": (chain(), "u[n+1]; u[n-1]; u[n]**3; sin(2*u[n]); v[n]; 1/(2+u[n]**2)", 2, False),
    "free ends": (chain(5, "free"), "u[n+1]; u[n-2]; u[n]**2*v[n+1]; sign(v[n]); abs(u[n])", 2, False),
    "antiperiodic ends": (chain(4, "antiperiodic"), "u[n+1]+u[n-1]; u[n]**5; n*u[n]; cos(1.7*t)", 2, False),
    "fixed ends and an input": (chain(4, "fixed", forced=True), "u[n+1]; f[n]; u[n]*f[n]; sqrt(abs(u[n])+1)", 2, False),
    "mirrored": (chain(), "u[n+1]; u[n]**2; u[n]**3", 2, True),
    "first order": (chain(6), "u[n+1]; u[n-1]; tanh(u[n])", 1, False),
    "complex": (
        chain(6, is_complex=True),
        "u[n+1]; i*u[n-1]; abs(u[n])**2*u[n]; i*conj(u[n])**2; abs(u[n+1])*u[n]",
        1,
        False,
    ),
    "complex, periodic": (chain(5, "periodic", is_complex=True), "u[n+1]; i*u[n]; i*u[n-1]**2", 1, True),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_written_by_hand_is_that_of_finite_differences(name):
    samples, texts, order, mirror = CASES[name]
    candidates = library("lib", texts)
    one = problem(samples, candidates, order, mirror=mirror)
    draw = np.random.default_rng(2)
    weights = initial_weights(one.form, 2.0, draw) + 0.05 * draw.normal(size=one.count)
    xi = draw.normal(size=len(candidates.terms))
    gradient, by_xi = np.zeros(one.count), np.zeros(len(xi))
    one.loss(weights, xi, gradient, by_xi)
    spare, rest = np.zeros(one.count), np.zeros(len(xi))
    for step in (draw.normal(size=one.count) / np.sqrt(one.count) for _ in range(4)):
        ahead, behind = (one.loss(weights + sign * 1e-5 * step, xi, spare, rest) for sign in (1, -1))
        assert gradient @ step == pytest.approx((ahead - behind) / 2e-5, rel=1e-6, abs=1e-7)
    for k in range(len(xi)):
        step = np.eye(len(xi))[k]
        ahead, behind = (one.loss(weights, xi + sign * 1e-5 * step, spare, rest) for sign in (1, -1))
        assert by_xi[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-6, abs=1e-7)


def test_the_loss_is_the_one_written_in_the_module():
    samples = chain(5)
    candidates = library("lib", "u[n+1]; u[n-1]; u[n]**3")
    one = problem(samples, candidates, 2)
    size = scales([samples], candidates, 2)
    weights = initial_weights(one.form, 2.0, np.random.default_rng(3))
    xi = np.array([0.3, -0.2, 0.7])
    found = one.loss(weights, xi, np.zeros(one.count), np.zeros(3))

    def curve(t):
        x, first = (t - 0.5) / 1.0 - 1, 0
        h = x[:, None]
        for number, (rows, width) in enumerate(one.form):
            layer = weights[first : first + rows * width].reshape(rows, width)
            first += rows * width
            h = h @ layer[:-1] + layer[-1]
            h = np.tanh(h) if number < len(one.form) - 1 else h
        return h[:, :5] * size.field, h[:, 5:] * size.velocity

    u, v = curve(samples.t)
    assert samples.v is not None
    data = np.mean((u - samples.u) ** 2) / size.field**2 + np.mean((v - samples.v) ** 2) / size.velocity**2
    t, e = np.linspace(0.5, 2.5, 41), 1e-5
    u, v = curve(t)
    du, dv = ((b - a) / (2 * e) for a, b in zip(curve(t - e), curve(t + e), strict=True))
    law = 0.3 * u[:, 2:] - 0.2 * u[:, :-2] + 0.7 * u[:, 1:-1] ** 3
    residual = np.mean((du - v) ** 2) / size.velocity**2 + np.mean((dv[:, 1:-1] - law) ** 2) / size.rate**2
    assert found == pytest.approx(100 * data + residual, rel=1e-8)


def test_terms_compiled_for_training_agree_with_plain_arithmetic():
    compiled = contracted(("u[n+1]**4", "sign(v[n])*u[n]", "u[n]**0.5", "1/u[n]**3"), False)
    u, ahead, v = np.array([0.5, 2.0]), np.array([-1.5, 0.2]), np.array([-0.3, 0.4])
    values = {("u", 0): u, ("u", 1): ahead, ("v", 0): v}
    found = compiled.function(*(values[slot.name, slot.offset] for slot in compiled.slots), 1.0, 2.0, 3.0, 4.0)
    np.testing.assert_allclose(found[0], ahead**4)
    np.testing.assert_allclose(found[1], [-0.5, 2.0])
    np.testing.assert_allclose(found[2], np.sqrt(u))
    np.testing.assert_allclose(found[3], u**-3.0)
    slopes = {
        slot.offset: value for (_, slot), value in zip(compiled.places, found[4:], strict=True) if slot.name == "u"
    }
    np.testing.assert_allclose(slopes[1], 4 * ahead**3)
    np.testing.assert_allclose(slopes[0], 2 * np.sign(v) + 1.5 / np.sqrt(u) - 12 * u**-4.0)
    assert [power(3.0, k) for k in (-2, 0, 1, 7)] == [1 / 9, 1.0, 3.0, 2187.0]


def test_a_short_fit_finds_an_oscillator():
    samples, truth = oscillators()
    fit = solve(PINN(**FEW, adam_steps=300, lbfgs_steps=1500), [samples], library("lib", "u[n]; u[n]**3"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, truth, atol=5e-3)
    assert fit.residual < 0.01
    history = fit.history
    assert history is not None
    assert np.all(np.diff(history.step) > 0)
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


def test_a_complex_value_of_which_one_part_is_missing_is_no_sample():
    samples = chain(4, is_complex=True)
    u = samples.u.copy()
    # NumPy's NaN becomes NaN + 0 i.
    u[3, 1] = np.nan
    u[5, 2] = complex(0.3, np.nan)
    written = columns(Samples(samples.t, u), 1)
    assert sorted(zip(*np.nonzero(np.isnan(written)), strict=True)) == [(3, 1), (3, 5), (5, 2), (5, 6)]


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
    u = 1 + 0.1 * np.cos(np.sqrt(2) * t)[:, None]
    v = -0.1 * np.sqrt(2) * np.sin(np.sqrt(2) * t)[:, None]
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


def test_few_steps_on_phi4_already_point_the_right_way():
    system = systems.find("phi4")
    samples = simulate(system, sites=11, times=sample_times(25, 5.0))
    candidates = system.library("equation")
    fit = solve(PINN(collocation=101, adam_steps=500, lbfgs_steps=1500), [samples], candidates, 2, 0)
    truth = samples.truth(candidates)
    assert truth is not None
    assert np.linalg.norm(fit.coefficients - truth) <= 0.1 * np.linalg.norm(truth)


@pytest.mark.parametrize(
    ("name", "value"), [("layers", 0), ("collocation", 1), ("data_weight", 0.0), ("learning_rate", np.inf)]
)
def test_unsound_settings_are_named(name, value):
    with pytest.raises(InputError, match=name):
        make(PINN, {name: value})


@pytest.mark.parametrize("kind", [PINN, PINNVP])
@pytest.mark.parametrize("device", ["nonesuch", "cuda"])
def test_a_device_that_is_not_there_is_told_in_one_line(kind, device):
    torch = pytest.importorskip("torch")
    if device == "cuda" and torch.cuda.is_available():
        pytest.skip("it is there")
    samples, _ = oscillators()
    with pytest.raises(InputError, match=f"'{device}'.*use cpu") as caught:
        solve(kind(device=device), [samples], library("lib", "u[n]"), 2, 0)
    assert "\n" not in str(caught.value)


def test_an_input_that_was_never_seen_is_told():
    samples = Samples(np.arange(6.0), np.ones((6, 2)), f=np.full((6, 2), np.nan), source="here.csv")
    with pytest.raises(InputError, match=r"here\.csv.*f1"):
        inputs(samples, np.arange(3.0))


def test_torch_is_not_imported_with_the_module():
    code = "import sys, methods.pinn; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", CASES)
def test_a_batch_of_members_on_torch_has_the_losses_and_gradients_of_each_alone_on_numpy(name):
    pytest.importorskip("torch")
    samples, texts, order, mirror = CASES[name]
    candidates = library("lib", texts)
    one = problem(samples, candidates, order, mirror=mirror)
    settings = PINN(**FEW, mirror=mirror, device="cpu:0", members=3)
    sheets = [samples, samples.mirrored()] if mirror else [samples]
    batch = Problem(sheets, candidates, order, scales([samples], candidates, order), settings, 1.0)
    draw = np.random.default_rng(5)
    weights = np.stack([initial_weights(one.form, 2.0, draw) for _ in range(3)])
    xi = draw.normal(size=(3, len(candidates.terms)))
    gradient, by_xi = (batch.move(np.zeros(array.shape)) for array in (weights, xi))
    loss = batch.loss(batch.move(weights), batch.move(xi), gradient, by_xi)
    missed, whole = batch.left(batch.move(weights), batch.move(xi))
    for member in range(3):
        alone, rest = np.zeros(one.count), np.zeros(len(xi[0]))
        assert float(loss[member]) == pytest.approx(one.loss(weights[member], xi[member], alone, rest), rel=1e-12)
        np.testing.assert_allclose(np.asarray(gradient[member]), alone, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(np.asarray(by_xi[member]), rest, rtol=1e-9, atol=1e-11)
        expected = one.left(weights[member], xi[member])
        np.testing.assert_allclose([float(missed[member]), float(whole[member])], expected, rtol=1e-11)


def test_one_network_on_the_processor_has_the_numbers_that_it_had_before_there_were_members():
    samples, _ = oscillators()
    # Written down with the code as it was; few steps, so that round-off has not grown.
    before = {0: [-1.36435710869814, -0.3619149282486815], 1: [-2.383709343616671, 0.6031578967491639]}
    for seed, coefficients in before.items():
        method = PINN(**FEW, adam_steps=40, lbfgs_steps=20)
        fit = solve(method, [samples], library("lib", "u[n]; u[n]**3"), 2, seed)
        np.testing.assert_allclose(fit.coefficients, coefficients, rtol=1e-6)
        assert set(fit.found) == {"loss"}


@pytest.mark.parametrize("package", ["numpy", "torch"])
def test_every_member_of_a_lockstep_descent_comes_to_the_bottom_of_its_valley(package):
    xp = pytest.importorskip(package)
    # Rosenbrock's valleys of different depth, to whose ends (1, 1) no straight way leads.
    depth = xp.asarray([1.0, 100.0, 1000.0])

    def valley(point):
        x, y = point[:, 0], point[:, 1]
        bend = y - x**2
        slope = xp.stack([-2 * (1 - x) - 4 * depth * bend * x, 2 * depth * bend], -1)
        return (1 - x) ** 2 + depth * bend**2, slope

    start = xp.asarray([[-1.2, 1.0], [3.0, -4.0], [0.0, 2.0]])
    seen = []
    end = lockstep(valley, start, 400, 5, lambda step, loss, _point: seen.append((step, np.asarray(loss))), xp)
    np.testing.assert_allclose(np.asarray(end), np.ones((3, 2)), atol=1e-5)
    assert np.all(np.diff(np.stack([loss for _, loss in seen]), axis=0) <= 0)
    assert np.all(np.diff([step for step, _ in seen]) > 0)
    assert seen[-1][0] < 399


def test_a_member_at_rest_or_before_a_wall_does_not_hold_the_others_up():
    def function(point):
        # The first is at its minimum; where the second is beyond 2 it has no value; the third is a plain bowl.
        value, slope = np.sum(point**2, axis=1), 2 * point
        beyond = (np.arange(len(point)) == 1) & (np.abs(point[:, 0]) < 2)
        return np.where(beyond, np.nan, value), np.where(beyond[:, None], np.nan, slope)

    start = np.array([[0.0, 0.0], [3.0, 0.0], [5.0, -7.0]])
    end = lockstep(function, start, 500, 5, lambda *_: None, np)
    assert np.array_equal(end[0], [0, 0])
    assert 2 <= end[1, 0] < 2.1
    np.testing.assert_allclose(end[2], [0, 0], atol=1e-6)


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


def test_members_start_differently_and_the_first_as_one_alone():
    first, second, third = (draw.normal(size=5) for draw in member_draws(7, 3))
    assert np.array_equal(first, np.random.default_rng(7).normal(size=5))
    assert not np.array_equal(first, second)
    assert not np.array_equal(second, third)


def test_a_member_whose_loss_is_not_a_number_is_not_the_best_and_the_spread_is_a_standard_deviation():
    assert best_member(np.array([np.nan, 3.0, 2.0, np.inf])) == 2
    terms = library("lib", "u[n]; u[n]**3")
    assert spread(np.array([[1.0, 2.0]]), terms) == {}
    assert spread(np.array([[1.0, 2.0], [3.0, 2.0]]), terms) == {
        "members": 2.0, "spread of u[n]": pytest.approx(np.sqrt(2)), "spread of u[n]**3": 0.0,
    }  # fmt: skip
