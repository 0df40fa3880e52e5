"""Large data on the command line: stores in chunks, folders, and the memory that was given."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.apart import Apart, fit_apart
from latticebench.systems.simulate import observe, sample_times, simulate
from latticebench.systems.writers import write
from tests.commandline import succeed

TERMS = ("--system", "phi4", "--library", "lib2")


def fitted(path: str, folder: Path, *more: object) -> np.ndarray:
    found = json.loads(succeed("fit", path, *TERMS, *more, "--json", "-", cwd=folder))
    return np.array(list(found["coefficients"].values()))


def test_a_store_and_a_folder_are_written_and_fitted_as_one_file_is(tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    common = ("simulate", "phi4", "--samples", 30, "--noise", 0.01, "--trajectories", 2, "--out")
    for out in ("one.npz", "chunks.zarr"):
        succeed(*common, out, cwd=tmp_path)
    succeed(*common, "parts.parquet", "--parts", cwd=tmp_path)
    expected = fitted("one.npz", tmp_path, "--method", "stlsq")
    assert np.any(expected)
    for path in ("chunks.zarr", "parts.parquet"):
        np.testing.assert_array_equal(fitted(path, tmp_path, "--method", "stlsq"), expected)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["stlsq", "weak"])
def test_a_chain_of_20_000_sites_is_fitted_within_one_gibibyte(tmp_path: Path, method: str) -> None:
    system = systems.find("phi4")
    clean = simulate(system, sites=20_000, times=sample_times(60, 5.0), integrator="dop853")
    path = tmp_path / "chain.npz"
    write([observe(clean, np.random.default_rng(1), noise=0.01).observed()], path)
    terms = system.library("lib2")
    asked = Apart(
        files=(path,), ends="free", terms=terms.texts, order=2, method=method, settings={}, seed=1, time_limit=3600,
        memory_limit=1024,
    )  # fmt: skip
    assert np.all(np.isfinite(fit_apart(asked, terms).coefficients))
