"""Samples in the layout of the fields."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.networks.equation import columns
from latticebench.systems.samples import Samples


def test_a_complex_value_of_which_one_part_is_missing_is_no_sample():
    t = np.arange(8.0)
    u = np.exp(1j * t)[:, None] * np.ones(4)
    # NumPy's NaN becomes NaN + 0 i.
    u[3, 1] = np.nan
    u[5, 2] = complex(0.3, np.nan)
    written = columns(Samples(t, u), 1)
    assert sorted(zip(*np.nonzero(np.isnan(written)), strict=True)) == [(3, 1), (3, 5), (5, 2), (5, 6)]
