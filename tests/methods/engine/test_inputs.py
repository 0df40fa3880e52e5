"""Measured inputs between their samples."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.inputs import inputs
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples


def test_an_input_that_was_never_seen_is_told():
    samples = Samples(np.arange(6.0), np.ones((6, 2)), f=np.full((6, 2), np.nan), source="here.csv")
    with pytest.raises(InputError, match=r"here\.csv.*f1"):
        inputs(samples, np.arange(3.0))
