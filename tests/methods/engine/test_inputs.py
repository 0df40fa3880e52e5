"""Measured inputs between their samples."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.inputs import inputs
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples


def test_an_input_that_was_never_seen_is_told():
    samples = Samples(np.arange(6.0), np.ones((6, 2)), f=np.full((6, 2), np.nan), source="here.csv")
    with pytest.raises(InputError, match=r"here\.csv.*input of site 1"):
        inputs(samples, np.arange(3.0))


def test_a_gap_is_bridged_by_a_straight_line_whatever_the_method():
    t = np.linspace(0, 6, 61)
    f = np.stack([np.sin(t), np.cos(t)], axis=1)
    f[20:30, 0] = np.nan
    samples = Samples(t, np.ones((61, 2)), f=f)
    middle = np.linspace(t[21], t[28], 50)
    found = inputs(samples, middle)
    straight = np.interp(middle, t[[19, 30]], f[[19, 30], 0])
    np.testing.assert_allclose(found[:, 0], straight, atol=0.01)
    np.testing.assert_allclose(found[:, 1], np.cos(middle), atol=1e-5)
    np.testing.assert_array_equal(found, samples.forcing()(middle))
