"""What every registered method must do, whatever it is: a new file is tested without writing a test."""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from latticebench import methods, systems
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.method import Abilities, Fit, Skipped, make, obstacle, settings, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import observe, sample_times, simulate
from latticebench.systems.stencil import evaluate

# Settings that make a slow method fast enough for a test; what it finds is not judged here.
QUICK = {
    "adam_steps": 20, "lbfgs_steps": 20, "collocation": 31, "max_iterations": 5, "steps": 20, "iterations": 5,
    "models": 5, "domains": 20,
}  # fmt: skip

# A method whose solver is not installed is skipped, see test_miosr.
METHODS = sorted(name for name, kind in methods.registered().items() if not kind().abilities.missing_packages)


Fitted = Callable[..., Fit | str]


def attempt(
    name: str, samples: SimulatedSamples, candidates: Library, order: int, usual: tuple[str, ...] = ()
) -> Fit | str:
    """Return the fit, or the reason why the method cannot."""
    try:
        return solve(quick(name, usual), [samples], candidates, order, seed=3)
    except Skipped as skipped:
        return str(skipped)


def quick(name: str, usual: tuple[str, ...] = ()) -> methods.method.Method:
    """Make a method with settings that are quick, but for some that stay as usual."""
    kind = methods.find(name)
    return make(kind, {key: value for key, value in QUICK.items() if key in settings(kind) and key not in usual})


@pytest.fixture(scope="module")
def phi4() -> SimulatedSamples:
    clean = simulate(systems.find("phi4"), sites=11, times=sample_times(31, 4.0), integrator="dop853")
    return observe(clean, np.random.default_rng(5), noise=0.001)


@pytest.fixture(scope="module")
def dnls() -> SimulatedSamples:
    clean = simulate(
        systems.find("dnls"), parameters={"C": 0.5}, sites=9, times=sample_times(31, 4.0), integrator="dop853"
    )
    return observe(clean, np.random.default_rng(5), noise=0.001)


@pytest.fixture(scope="module")
def fitted(phi4: SimulatedSamples, dnls: SimulatedSamples) -> Fitted:
    """Fit the samples of a lattice by a method, once for all tests; or say why the method cannot."""
    samples, found = {"phi4": phi4, "dnls": dnls}, {}

    def fit(name: str, data: str, *usual: str) -> Fit | str:
        changed = tuple(key for key in usual if key in settings(methods.find(name)))
        if (name, data, changed) not in found:
            system = systems.find(data)
            candidates = system.library("lib2" if data == "phi4" else "four")
            found[name, data, changed] = attempt(name, samples[data], candidates, system.order, changed)
        return found[name, data, changed]

    return fit


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_a_frozen_dataclass_with_a_name_and_a_docstring(name: str) -> None:
    kind = methods.find(name)
    assert kind.name == name
    assert (kind.__doc__ or "").strip()
    assert isinstance(kind().abilities, Abilities)
    for one in dataclasses.fields(kind):  # type: ignore[arg-type]
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(kind(), one.name, None)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("data", ["phi4", "dnls"])
def test_a_fit_has_one_finite_coefficient_a_term_and_is_timed(name: str, data: str, fitted: Fitted) -> None:
    system = systems.find(data)
    candidates = system.library("lib2" if data == "phi4" else "four")
    fit = fitted(name, data)
    if isinstance(fit, str):
        assert "complex" in fit
        assert system.is_complex
        return
    assert fit.method == name
    assert fit.order == system.order
    assert fit.library == candidates
    assert np.all(np.isfinite(fit.coefficients))
    assert fit.seconds > 0
    if fit.stderr is not None:
        assert fit.stderr.shape == fit.coefficients.shape
    if fit.history is not None:
        assert fit.history.coefficients.shape == (len(fit.history.step), len(candidates.terms))
        assert np.all(np.diff(fit.history.step) > 0)
        assert np.all(np.diff(fit.history.seconds) >= 0)
        assert fit.history.seconds[0] >= 0
        assert fit.history.seconds[-1] <= fit.seconds


@pytest.mark.parametrize("name", METHODS)
def test_the_same_seed_gives_the_same_coefficients_to_the_last_digit(
    name: str, phi4: SimulatedSamples, fitted: Fitted
) -> None:
    first, second = fitted(name, "phi4"), attempt(name, phi4, systems.find("phi4").library("lib2"), 2)
    assert isinstance(first, Fit)
    assert isinstance(second, Fit)
    assert np.array_equal(first.coefficients, second.coefficients)


@pytest.mark.parametrize("name", METHODS)
def test_only_a_method_that_declares_it_is_shown_the_truth(
    name: str, phi4: SimulatedSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[Samples]] = []
    kind = methods.find(name)

    def spy(self: object, data: list[Samples], library: object, order: int, seed: int) -> Fit:
        seen.append(list(data))
        return Fit(name, library, order, np.zeros(4), 0.0)  # type: ignore[arg-type]

    monkeypatch.setattr(kind, "fit", spy)
    solve(kind(), [phi4], systems.find("phi4").library("lib2"), 2, seed=3)
    told = isinstance(seen[0][0], SimulatedSamples)
    assert told == kind().abilities.truth
    if not told:
        assert seen[0][0].sigma is None


@pytest.mark.parametrize("name", METHODS)
def test_a_method_takes_missing_values_and_uneven_times_or_says_why_not(name: str) -> None:
    times = sample_times(40, 4.0, np.random.default_rng(2))
    clean = simulate(systems.find("phi4"), sites=11, times=times, integrator="dop853")
    gappy = observe(clean, np.random.default_rng(1), noise=0.001, missing=0.05)
    fit = attempt(name, gappy, systems.find("phi4").library("lib2"), 2)
    if isinstance(fit, str):
        assert "missing" in fit or "even" in fit
    else:
        assert np.all(np.isfinite(fit.coefficients))


@pytest.mark.parametrize("name", METHODS)
def test_two_trajectories_are_fitted_together(name: str, phi4: SimulatedSamples) -> None:
    other = simulate(
        systems.find("phi4"), sites=11, times=sample_times(25, 3.0), integrator="dop853",
        variation=np.random.default_rng(8),
    )  # fmt: skip
    fit = solve(quick(name), [phi4, other], systems.find("phi4").library("equation"), 2, seed=1)
    assert np.all(np.isfinite(fit.coefficients))


@pytest.mark.parametrize("name", METHODS)
def test_an_unknown_setting_is_refused_by_name(name: str) -> None:
    with pytest.raises(InputError, match="unknown setting 'thresold'"):
        make(methods.find(name), {"thresold": 1})


# What no setting of any method may be; a text may also be typed on the command line.
WRONG: tuple[object, ...] = (
    -1, -1e-300, math.nan, math.inf, -math.inf, 10**400, True, "", "nope", " ", [], [-1], [True], [math.nan], ["nope"],
    [[]], {"nope": 1}, {"": math.nan}, {"threshold": -math.inf}, datetime.date(1979, 5, 27), b"x", None,
)  # fmt: skip
WRONG_TEXTS = ("", " ", "-1", "nan", "inf", "-inf", "1e999", "nope", "[", "[-1]", "[NaN]", "{", "[" * 9999, "9" * 9999)


def allowed(default: object, value: object) -> bool:
    """Whether a value is right after all: a boolean has no bounds, and None stands for no options."""
    return (isinstance(default, bool) and value in (True, "1")) or (default is None and value is None)


@pytest.mark.parametrize("name", METHODS)
def test_every_setting_refuses_what_is_out_of_range_or_of_another_type_by_its_name(name: str) -> None:
    kind = methods.find(name)
    for key, default in settings(kind).items():
        for value in WRONG:
            if not allowed(default, value):
                with pytest.raises(InputError) as refusal:
                    make(kind, {key: value})
                assert key in str(refusal.value) or "with {" in str(refusal.value), (key, value, str(refusal.value))
        for text in WRONG_TEXTS:
            with pytest.raises(InputError):
                make(kind, {key: text}, texts=True)
        # What is right is kept, as a value of a suite and as a text that is typed.
        assert getattr(make(kind, {key: default}), key) == default
        if isinstance(default, (bool, int, float, str)):
            assert getattr(make(kind, {key: str(default)}, texts=True), key) == default


@pytest.mark.parametrize("name", METHODS)
def test_a_method_that_was_made_without_a_check_is_checked_before_it_fits(name: str, phi4: SimulatedSamples) -> None:
    kind = methods.find(name)
    for key, default in settings(kind).items():
        if isinstance(default, (int, float)) and not isinstance(default, bool):
            with pytest.raises(InputError, match=f"setting {key} = -1"):
                solve(kind(**{key: -1}), [phi4], systems.find("phi4").library("lib1"), 2, seed=1)


def test_a_library_that_the_data_cannot_serve_is_refused_with_the_reason(phi4: SimulatedSamples) -> None:
    method = methods.find("least-squares")()
    observed = phi4.observed()
    for terms, order, reason in [
        ("f[n]", 2, "no measured input"),
        ("i*u[n]", 2, "the field is real"),
        ("v[n]", 1, "has no velocity"),
        ("u[n+6]; u[n-6]", 2, "stencil needs 13 sites, the data have 11"),
        ("u[n]", 3, "must be 1"),
    ]:
        with pytest.raises(InputError, match=reason):
            solve(method, [observed], library("mine", terms), order, seed=1)


def test_with_known_ends_every_site_counts_so_that_a_chain_of_two_can_be_fitted() -> None:
    times = sample_times(200, 10.0)
    first, second = np.cos(times), np.cos(np.sqrt(3.0) * times)
    # u_1'' = -2 u_1 + u_2 with walls on both sides: the modes (1, 1) and (1, -1) have the frequencies 1 and sqrt 3.
    u = np.column_stack([first + second, first - second])
    walls = Samples(times, u, ends="fixed")
    fit = solve(methods.find("least-squares")(), [walls], library("chain", "u[n+1]+u[n-1]; u[n]"), 2, seed=1)
    np.testing.assert_allclose(fit.coefficients, [1.0, -2.0], atol=1e-4)
    with pytest.raises(InputError, match="say how the chain ends"):
        solve(methods.find("least-squares")(), [Samples(times, u)], library("chain", "u[n+1]+u[n-1]; u[n]"), 2, seed=1)


def test_the_mirror_image_of_an_odd_equation_has_the_same_truth_and_another_has_none(phi4: SimulatedSamples) -> None:
    mirrored = phi4.mirrored()
    assert np.array_equal(mirrored.u, -phi4.u)
    fit = solve(methods.find("oracle")(), [mirrored], systems.find("phi4").library("lib2"), 2, seed=1)
    np.testing.assert_allclose(fit.coefficients, [2, 2, -2, -2], rtol=1e-10)
    with pytest.raises(InputError, match="not odd"):
        dataclasses.replace(phi4, equation="u[n]**2").mirrored()


@pytest.mark.parametrize("data", ["phi4", "dnls"])
@pytest.mark.parametrize("name", [name for name in METHODS if methods.find(name)().abilities.motion])
def test_a_method_that_says_so_gives_the_motion_and_the_noise_beside_it(
    name: str, data: str, request: pytest.FixtureRequest, fitted: Fitted
) -> None:
    samples = request.getfixturevalue(data)
    system = systems.find(data)
    fit = fitted(name, data)
    if isinstance(fit, str):
        return
    assert fit.motion is not None
    (motion,) = fit.motion
    noise = np.std(samples.u - samples.exact.u) / np.sqrt(1 + samples.is_complex)
    assert float(fit.found["noise_u"]) == pytest.approx(noise, rel=0.3)
    # Nearer to the truth than the samples are.
    assert np.std(motion.u - samples.exact.u) < 0.8 * np.std(samples.u - samples.exact.u)
    if system.order == 2:
        assert np.std(motion.v - samples.exact.v) < 0.8 * np.std(samples.v - samples.exact.v)
        assert "noise_v" in fit.found


@pytest.mark.parametrize("data", ["phi4", "dnls"])
@pytest.mark.parametrize("name", METHODS)
def test_curves_that_a_method_gives_follow_the_samples_and_their_levels_are_derivatives(
    name: str, data: str, request: pytest.FixtureRequest, fitted: Fitted
) -> None:
    samples = request.getfixturevalue(data)
    system = systems.find(data)
    # Derivatives are compared by quadrature over the points where the method asks for the equation: its own number.
    fit = fitted(name, data, "collocation")
    if isinstance(fit, str) or fit.smooth is None:
        return
    (curves,) = fit.smooth
    parts = 1 + samples.is_complex
    assert curves.levels.shape == (system.order + 1, len(curves.times), parts, samples.sites)
    assert np.sum(curves.share) == pytest.approx(1)
    inner = (samples.t >= curves.times[0]) & (samples.t <= curves.times[-1])
    there = CubicHermiteSpline(curves.times, curves.levels[0], curves.levels[1])(samples.t[inner])
    noise = np.std(samples.u - samples.exact.u) / np.sqrt(parts)
    exact = split_parts(samples.exact.u[inner], samples.is_complex)
    assert np.sqrt(np.mean((there - exact) ** 2)) < noise
    for lower, upper in itertools.pairwise(curves.levels):
        # At the ends, where nothing holds them, they bend too fast for a quadrature.
        inside = slice(len(lower) // 10, -len(lower) // 10)
        gone = CubicSpline(curves.times, upper).antiderivative()(curves.times)[inside]
        np.testing.assert_allclose(gone - gone[0], lower[inside] - lower[inside][0], atol=0.01 * np.max(np.abs(lower)))


def test_a_method_that_the_memory_does_not_suffice_for_says_so_before_it_starts():
    @dataclasses.dataclass(frozen=True)
    class Hungry:
        name = "hungry"
        abilities = Abilities(memory=1e15)

        def fit(self, data, library, order, seed):
            raise AssertionError("it was started")

    t = np.linspace(0, 1, 20)
    data = [Samples(t, np.sin(t)[:, None] * np.ones(3))]
    with pytest.raises(Skipped, match=r"1.1e\+08 GiB for 60 values and 2 terms.* piece by piece"):
        solve(Hungry(), data, library("own", "u[n]; u[n]**3"), 2, 1)
    assert "piece" not in obstacle(Abilities(memory=1.0), data, library("own", "u[n]"))


# Methods whose residual is not that of a differentiated equation.
OTHERWISE = {name for name in METHODS if methods.find(name)().abilities.motion} | {"zero", "oracle", "pinn"}


@pytest.mark.parametrize("name", sorted(set(METHODS) - OTHERWISE))
@pytest.mark.parametrize("system", ["phi4", "dnls"])
def test_the_residual_is_the_share_of_the_derivative_that_an_equation_leaves_which_lacks_a_term(
    name: str, system: str
) -> None:
    found = systems.find(system)
    clean = simulate(found, sites=11, times=sample_times(41, 8.0), integrator="dop853")
    fewer = library("fewer", found.library("equation").texts[:-1])
    fit = solve(make(methods.find(name), {}), [clean], fewer, found.order, seed=3)
    values = evaluate(fewer.terms, clean.exact.u, clean.exact.v, None, clean.t, ends="unknown")
    rate = split_parts(clean.rate[:, 1:-1], clean.is_complex).swapaxes(0, 1)
    wanted = rate - np.tensordot(fit.coefficients, values, (0, 1))
    assert fit.residual == pytest.approx(np.linalg.norm(wanted) / np.linalg.norm(rate), rel=0.3)


@pytest.mark.parametrize("data", ["phi4", "dnls"])
@pytest.mark.parametrize("name", [name for name in METHODS if methods.find(name)().abilities.motion])
def test_the_residual_of_a_motion_is_its_share_of_the_readings(
    name: str, data: str, request: pytest.FixtureRequest, fitted: Fitted
) -> None:
    samples, fit = request.getfixturevalue(data), fitted(name, data)
    if isinstance(fit, str):
        return
    assert fit.motion is not None
    left = np.linalg.norm(fit.motion[0].u - samples.u)
    assert fit.residual == pytest.approx(left / np.linalg.norm(samples.u), rel=1e-3)
