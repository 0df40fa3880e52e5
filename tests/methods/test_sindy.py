"""Sparse regression: pysindy does the selecting, the scaling is this project's."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.methods.engine.regression import Regression
from latticebench.methods.engine.sparse import sparse_fit
from latticebench.methods.method import make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import simulate


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulate(systems.find("phi4"), integrator="dop853").observed()


def test_stlsq_keeps_the_true_terms_and_gives_least_squares_on_them(samples: Samples) -> None:
    candidates = systems.find("phi4").library("lib3")
    sparse = solve(make(methods.find("stlsq"), {}), [samples], candidates, 2, seed=1)
    assert list(sparse.coefficients != 0) == [True, True, True, True, False, False]
    dense = solve(make(methods.find("least-squares"), {}), [samples], systems.find("phi4").library("lib2"), 2, seed=1)
    # The wider library loses the sites at the ends, hence not the same to the last digit.
    np.testing.assert_allclose(sparse.coefficients[:4], dense.coefficients, rtol=5e-3)


@pytest.mark.parametrize("name", ["stlsq", "sr3"])
def test_what_is_dropped_does_not_depend_on_units(name: str, samples: Samples) -> None:
    rng = np.random.default_rng(1)
    design = rng.normal(size=(200, 4))
    target = design @ [1.0, 0.0, -0.5, 0.02] + 1e-3 * rng.normal(size=200)
    units = np.array([1e6, 1e-6, 3.0, 1e3])
    optimizer, arguments = {
        "stlsq": ("STLSQ", {"threshold": 0.05, "alpha": 0.0}),
        "sr3": ("SR3", {"reg_weight_lam": 0.00125, "unbias": True}),
    }[name]
    plain = sparse_fit(Regression(design, target), optimizer, arguments, seed=1)
    scaled = sparse_fit(Regression(design * units, 1e4 * target), optimizer, arguments, seed=1)
    assert list(plain != 0) == [True, False, True, False]
    np.testing.assert_allclose(scaled * units / 1e4, plain, rtol=1e-9)


@pytest.mark.parametrize("optimizer", ["SSR", "FROLS", "STLSQ", "SR3"])
def test_any_optimiser_of_pysindy_works_by_its_name(optimizer: str, samples: Samples) -> None:
    method = make(methods.find("pysindy"), {"optimizer": optimizer})
    fit = solve(method, [samples], systems.find("phi4").library("lib1"), 2, seed=1)
    assert fit.residual < 0.2


def test_bagging_is_seeded_made_afresh_and_leaves_the_global_generator_alone(samples: Samples) -> None:
    rng = np.random.default_rng(1)
    design = rng.normal(size=(100, 3))
    rows = Regression(design, design @ [1.0, 2.0, 0.0] + 0.1 * rng.normal(size=100))
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    import pysindy

    def bagged() -> np.ndarray:
        inner = pysindy.STLSQ(threshold=0.05, alpha=0.0)
        return sparse_fit(rows, "EnsembleOptimizer", {"opt": inner, "bagging": True, "n_models": 5}, seed=4)

    assert np.array_equal(bagged(), bagged())
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002


def test_an_unknown_optimiser_or_argument_is_told(samples: Samples) -> None:
    candidates = systems.find("phi4").library("lib1")
    with pytest.raises(InputError, match="did you mean 'FROLS'"):
        solve(make(methods.find("pysindy"), {"optimizer": "FROL"}), [samples], candidates, 2, seed=1)
    with pytest.raises(InputError, match="FROLS"):
        solve(make(methods.find("pysindy"), {"arguments": {"nonsense": 1}}), [samples], candidates, 2, seed=1)


@pytest.mark.parametrize(("library", "bound"), [("lib1", 1e-3), ("lib2", 1e-3), ("lib3", 1e-3)])
def test_least_squares_on_a_quintic_spline_is_within_a_thousandth_and_the_oracle_exact(
    library: str, bound: float
) -> None:
    system = systems.find("phi4")
    clean = simulate(system)
    candidates = system.library(library)
    truth = clean.truth(candidates)
    assert truth is not None

    def error(name: str, **given: object) -> float:
        found = solve(make(methods.find(name), given), [clean], candidates, 2, seed=1).coefficients
        return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))

    assert error("least-squares", differentiation="spline") <= bound
    assert error("least-squares") <= bound
    # Conditioning 40 to 75: rounding of the samples makes some 1e-14.
    assert error("oracle") <= 1e-12
    assert error("zero") == 1.0


def test_rows_in_which_a_term_is_not_finite_are_left_out_and_said_so_only_if_none_is_left() -> None:
    t = np.linspace(0.0, 3.0, 40)
    u = np.column_stack([np.cos(t), 2 + np.sin(t)])
    candidates = library("two", "u[n]; exp(400*u[n])")
    # exp(710) overflows.
    some = solve(make(methods.find("least-squares"), {}), [Samples(t, u, ends="free")], candidates, 2, seed=1)
    assert np.all(np.isfinite(some.coefficients))
    with pytest.raises(InputError, match="in every row a term of the library is not finite"):
        solve(make(methods.find("least-squares"), {}), [Samples(t, u + 5, ends="free")], candidates, 2, seed=1)
