"""A site that was never read moves as the equation says; readings that determine no coefficient are refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from commandline import soon
from latticebench import methods
from latticebench.bench.adequacy import adequacy
from latticebench.methods.method import make, solve
from latticebench.systems import find
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Origin, Samples
from latticebench.systems.simulate import observe, simulate

PHI4 = find("phi4")
LIBRARY = PHI4.library("lib2")
TRUTH = np.array([2.0, 2.0, -2.0, -2.0])


def unread(*sites: int, count: int, ends="free") -> Samples:
    """Readings of a phi^4 chain without those of some sites."""
    clean = simulate(PHI4, parameters={"C": 2.0, "v": 0.5}, sites=count, ends="free")
    noisy = observe(clean, np.random.default_rng(5), noise=0.005)
    fields = [np.where(np.isin(np.arange(count), sites), np.nan, one) for one in (noisy.u, noisy.v)]
    return Samples(noisy.t, *fields, source="chain.csv", ends=ends)


@pytest.mark.parametrize("ends", ["free", "unknown"])
def test_a_chain_with_a_site_that_was_never_read_is_fitted_and_no_misfit_is_told(ends):
    data = unread(4, count=9, ends=ends)
    found = solve(make(methods.find("trajectory"), {}), [data], LIBRARY, 2, 1)
    assert np.all(np.abs(found.coefficients - TRUTH) < 6 * found.stderr)
    assert np.all(found.stderr < 0.05)
    quality = adequacy([data], found)
    assert (quality.fits, quality.warnings) == (True, ())
    # The same equation of a method that follows no motion.
    assert adequacy([data], dataclasses.replace(found, motion=None)).fits
    wrong = dataclasses.replace(found, motion=None, coefficients=1.5 * found.coefficients)
    assert not adequacy([data], wrong).fits


@pytest.mark.parametrize("method", sorted(methods.registered()))
def test_as_many_unread_sites_as_equations_are_refused_whatever_the_method(method):
    data = dataclasses.replace(unread(1, count=3, ends="unknown"), origin=Origin(columns=("a", "b", "c")))
    with pytest.raises(InputError, match=r"chain\.csv: nothing was ever read of b, and only 1 site\(s\).*--ends"):
        solve(make(methods.find(method), {}), [data], LIBRARY, 2, 1)


def test_coefficients_that_the_readings_do_not_determine_are_told():
    data = unread(count=5)
    found = solve(make(methods.find("trajectory"), {}), [data], LIBRARY, 2, 1)
    assert adequacy([data], found).state("ok") == "ok"
    unsure = dataclasses.replace(found, stderr=np.where(np.arange(4) == 3, 1e3, found.stderr))
    quality = adequacy([data], unsure)
    assert quality.unknown == ("u[n]**3",)
    assert not quality.fits
    assert quality.state(unsure.status) == "not determined by the readings"
    assert quality.warnings[-1].startswith("the readings do not determine the coefficients of u[n]**3: ")


def test_the_command_line_says_that_a_column_is_empty(tmp_path: Path):
    data = unread(2, count=7)
    columns = [f"u{site}" for site in range(1, 8)]
    rows = [
        ",".join([repr(float(t)), *("" if np.isnan(one) else repr(float(one)) for one in row)])
        for t, row in zip(data.t, data.u, strict=True)
    ]
    table = "\n".join([f"t,{','.join(columns)}", *rows])
    (tmp_path / "chain.csv").write_text(table + "\n")
    terms = "; ".join(LIBRARY.texts)
    code, out, err = soon(
        "fit", "chain.csv", "--terms", terms, "--order", 2, "--ends", "free", "--method", "trajectory", cwd=tmp_path
    )
    assert code == 0
    assert err == ""
    assert "; nothing was read of u3\n" in out
    assert "trajectory: ok" in out
