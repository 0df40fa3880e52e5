"""The weak equations of a chain some sites at a time: the same as those of the whole chain at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods.engine.errors_in_variables import sparse_estimate
from latticebench.methods.engine.weak_covariance import Sweep
from latticebench.methods.engine.weak_form import WeakForm
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate
from latticebench.systems.stencil import Ends

# Far fewer values than any of these chains has.
FEW = 1000
NEARLY_DEPENDENT = library("near", "u[n+1]; u[n-1]; u[n]; u[n]**3; u[n]**5; sin(u[n])")


def chain(name: str, ends: Ends, missing: float = 0.0, sites: int = 52) -> Samples:
    clean = simulate(
        systems.find(name), sites=sites, times=sample_times(40, 4.0), integrator="dop853",
        ends=None if ends == "unknown" else ends, variation=np.random.default_rng(4),
    )  # fmt: skip
    return replace(observe(clean, np.random.default_rng(1), noise=0.01, missing=missing).observed(), ends=ends)


def of(name: str) -> tuple[Library, int]:
    system = systems.find(name)
    return system.library("lib3" if name == "phi4" else "four"), system.order


CASES = [
    ("phi4", "periodic", 0.0), ("phi4", "antiperiodic", 0.1), ("phi4", "free", 0.1), ("phi4", "unknown", 0.0),
    ("dnls", "free", 0.0), ("dnls", "periodic", 0.1),
]  # fmt: skip


@pytest.mark.parametrize(("name", "ends", "missing"), CASES)
def test_blocks_of_a_chain_have_the_rows_and_the_nearest_state_of_one_dense_covariance(
    name: str, ends: Ends, missing: float
) -> None:
    terms, order = of(name)
    form = WeakForm(chain(name, ends, missing), terms, order, most=FEW)
    assert len(form.cuts) > 3
    coefficients = np.linspace(-1.0, 1.0, len(terms.terms))
    seen = form.state.seen
    w = seen + 0.1 * np.random.default_rng(2).normal(size=seen.shape)
    sweep = Sweep(form, w, coefficients, accuracy=1e-6)
    found = sweep.rows()

    # The whole chain as one block, its Jacobian written out.
    whole = WeakForm(chain(name, ends, missing), terms, order, most=10**12)
    target, design = whole.rows(w, whole.block(0))
    slopes = whole.slopes(w, coefficients, whole.block(0))
    jacobian = np.zeros((len(whole.sites), whole.parts, whole.count, *seen.shape))
    for site, channels in enumerate(slopes.channel):
        for read, channel in enumerate(channels):
            jacobian[site, :, :, channel] += slopes.matrix[site, read]
    jacobian = jacobian.reshape(target.size, -1)
    target = target.ravel() + jacobian @ (seen - w).ravel()
    design = design.reshape(target.size, -1)
    inverse = np.linalg.inv(jacobian @ jacobian.T + 1e-12 * np.eye(target.size))
    rows = np.column_stack([found.design, found.target])
    both = np.column_stack([design, target])
    expected = both.T @ inverse @ both
    np.testing.assert_allclose(rows.T @ rows, expected, atol=1e-8 * np.max(np.abs(expected)))
    assert found.size == target.size
    nearest = seen - (jacobian.T @ inverse @ (target - design @ coefficients)).reshape(seen.shape)
    np.testing.assert_allclose(sweep.nearest(coefficients), nearest, atol=1e-7 * np.max(np.abs(nearest)))


@pytest.mark.parametrize(("name", "ends", "missing"), CASES)
def test_the_estimate_by_blocks_is_that_of_the_whole_chain(name: str, ends: Ends, missing: float) -> None:
    terms, order = of(name)
    samples = chain(name, ends, missing)
    (found, support), (expected, same) = (
        sparse_estimate([WeakForm(samples, terms, order, most=most)]) for most in (FEW, 10**12)
    )
    assert np.array_equal(support, same)
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9)
    np.testing.assert_allclose(found.stderr, expected.stderr, rtol=1e-7)
    assert (found.rounds, found.regression.size) == (expected.rounds, expected.regression.size)


@pytest.mark.parametrize("size", [0.14, 0.15, 0.155, 0.16])
def test_terms_with_a_conditioning_of_a_million_have_the_coefficients_of_the_whole_chain(size: float) -> None:
    # A motion this small hardly tells the sine from u - u^3/6.
    samples = chain("sine-gordon", "free", sites=60)
    small = replace(samples, u=size * samples.u, v=size * samples.v)  # type: ignore[operator]
    forms = [WeakForm(small, NEARLY_DEPENDENT, 2, most=most) for most in (FEW, 10**12)]
    found, expected = (sparse_estimate([form], select=None)[0] for form in forms)
    scaled = expected.regression.design / np.linalg.norm(expected.regression.design, axis=0)
    assert 3e5 < np.linalg.cond(scaled) < 1e8
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9)
