"""Regression in pieces: the same coefficients as in one piece, whatever the conditioning, ends, gaps and field."""

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.methods.engine import derivatives, regression
from latticebench.methods.engine.regression import Regression, folded, rows, sums
from latticebench.methods.engine.sparse import sparse_fit
from latticebench.methods.method import make
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate

ENDS = ("unknown", "free", "fixed", "periodic", "antiperiodic")
METHODS = ("least-squares", "stlsq", "sr3")


def cut(whole, size):
    for begin in range(0, len(whole.target), size):
        yield Regression(whole.design[begin : begin + size], whole.target[begin : begin + size])


def conditioned(conditioning, terms=7, count=5000):
    """Rows whose design has this conditioning also after its columns are scaled, and their coefficients."""
    draw = np.random.default_rng(3)
    basis = np.linalg.qr(draw.normal(size=(count, terms)))[0]
    mixing = np.linalg.qr(draw.normal(size=(terms, terms)))[0]
    design = basis @ np.diag(np.geomspace(1, 1 / conditioning, terms)) @ mixing * np.sqrt(count)
    truth = np.where(np.arange(terms) % 3 == 1, 0.0, 1 + np.arange(terms) / 5)
    return Regression(design, design @ truth + 1e-9 * draw.normal(size=count)), truth


def noisy(name, sites=14, samples=25, missing=0.0, ends="free", velocities=True):
    clean = simulate(systems.find(name), sites=sites, times=sample_times(samples, 4.0), ends="free")
    seen = observe(clean, np.random.default_rng(1), noise=0.01, missing=missing, velocities=velocities)
    return Samples(seen.t, seen.u, seen.v, ends=ends)


@pytest.fixture
def small_pieces(monkeypatch):
    """Let a piece hold the rows of a few sites, a spline see a few sites at once, and a look at all a single row."""

    def shrink(values):
        monkeypatch.setattr(regression, "PIECE", values)
        monkeypatch.setattr(derivatives, "pieces", lambda count, size: (slice(k, k + 3) for k in range(0, count, 3)))
        for room in (derivatives, regression):
            monkeypatch.setattr(room, "rows_of", lambda array: (slice(k, k + 1) for k in range(len(array))))

    return shrink


@pytest.mark.parametrize("conditioning", [10.0, 1e6])
@pytest.mark.parametrize("size", [3, 7, 8, 613, 4999])
def test_folded_pieces_give_the_least_squares_of_all_rows_to_nine_digits(conditioning, size):
    whole, truth = conditioned(conditioning)
    assert 0.01 * conditioning < np.linalg.cond(whole.design / whole.scales) < 10 * conditioning
    small = folded(cut(whole, size))
    assert len(small.target) <= whole.design.shape[1] + 1
    assert small.size == 5000
    for support in (None, truth != 0):
        wanted = np.linalg.lstsq(whole.design[:, slice(None) if support is None else support], whole.target)[0]
        found = small.least_squares(support)
        np.testing.assert_allclose(found if support is None else found[support], wanted, rtol=1e-9, atol=1e-9)
        assert small.residual(found) == pytest.approx(whole.residual(found), rel=1e-6)
    np.testing.assert_allclose(small.scales, whole.scales, rtol=1e-12)


def test_normal_equations_would_lose_those_digits():
    whole, _ = conditioned(1e6)
    wanted = np.linalg.lstsq(whole.design, whole.target)[0]
    squared = np.linalg.solve(whole.design.T @ whole.design, whole.design.T @ whole.target)
    assert np.max(np.abs(squared / wanted - 1)) > 1e-8


@pytest.mark.parametrize("alpha", [0.0, 0.1])
@pytest.mark.parametrize("threshold", [0.01, 0.2, 0.5])
def test_a_threshold_keeps_the_same_terms_of_the_folded_rows(threshold, alpha):
    draw = np.random.default_rng(5)
    design = draw.normal(size=(4000, 9)) * np.geomspace(1e-3, 1e3, 9)
    target = design @ (np.array([3, 0, 0.02, 1, 0, 0.3, 0, 0.005, 2]) / np.geomspace(1e-3, 1e3, 9))
    whole = Regression(design, target + 0.1 * draw.normal(size=4000))
    for name, given in (
        ("STLSQ", {"threshold": threshold, "alpha": alpha}),
        ("SR3", {"reg_weight_lam": threshold**2 / 2, "unbias": True, "max_iter": 1000, "tol": 1e-12}),
        ("SSR", {"alpha": alpha, "kappa": threshold}),
    ):
        found = [sparse_fit(one, name, given, seed=1) for one in (whole, folded(cut(whole, 137)))]
        assert 0 < np.count_nonzero(found[0]) <= 9
        np.testing.assert_array_equal(found[0] != 0, found[1] != 0)
        np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-9 * np.max(np.abs(found[0])))


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("name", "library"), [("phi4", "lib3"), ("dnls", "four-next")])
def test_a_chain_in_windows_of_a_few_sites_gives_the_rows_of_the_whole_chain(small_pieces, name, library, ends):
    system = systems.find(name)
    data, terms = [noisy(name, ends=ends)], system.library(library)
    whole = rows(data, terms, system.order, "smoothing-spline")
    small_pieces(4 * 25 * len(terms.terms) * (1 + system.is_complex))
    cuts = rows(data, terms, system.order, "smoothing-spline")
    assert cuts.design.shape == whole.design.shape

    def in_order(one):
        table = np.column_stack([one.target, one.design])
        return table[np.argsort(table[:, 0])]

    np.testing.assert_allclose(in_order(cuts), in_order(whole), rtol=1e-8, atol=1e-8)
    assert sums(data, terms, system.order, "smoothing-spline").size == len(whole.target)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("name", "library", "given"),
    [
        ("phi4", "lib4", {}),
        ("phi4", "lib2", {"missing": 0.05}),
        ("phi4", "lib2", {"velocities": False}),
        ("dnls", "ten", {}),
        ("dnls", "four", {"missing": 0.05}),
    ],
)
def test_a_method_finds_the_same_in_pieces(small_pieces, method, name, library, given):
    system = systems.find(name)
    data = [noisy(name, **given), noisy(name, sites=9, **given)]
    one = make(methods.find(method), {})
    whole = one.fit(data, system.library(library), system.order, 1)
    small_pieces(3 * 25 * len(whole.coefficients))
    cuts = one.fit(data, system.library(library), system.order, 1)
    scale = np.max(np.abs(whole.coefficients))
    np.testing.assert_allclose(cuts.coefficients, whole.coefficients, rtol=1e-9, atol=1e-9 * scale)
    assert cuts.residual == pytest.approx(whole.residual, rel=1e-9)
    assert cuts.status == whole.status


def test_only_one_piece_is_in_memory_at_a_time(small_pieces):
    import tracemalloc

    small_pieces(50 * 40 * 4)
    peaks = []
    for sites in (2000, 8000):
        draw = np.random.default_rng(2)
        t = np.linspace(0, 4, 40)
        u = np.cos(t[:, None] * (1 + 0.1 * draw.normal(size=sites))) + 0.01 * draw.normal(size=(40, sites))
        data = [Samples(t, u, ends="free")]
        tracemalloc.start()
        sums(data, systems.find("phi4").library("lib2"), 2, "smoothing-spline")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # What looks for gaps and ends takes some bytes a site; rows of 4 terms at 40 times are 1 280.
    assert peaks[1] - peaks[0] < 6000 * 40 * 4
