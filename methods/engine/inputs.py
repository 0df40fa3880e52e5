"""A measured input at times other than those of its samples."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


def inputs(
    samples: Samples, times: Float[ndarray, " time"], some: slice | ndarray = slice(None)
) -> Float[ndarray, "time some"]:
    """Return the measured input of some sites at other times, as `Samples.forcing` has it: every method has the same.

    Raises:
        InputError: every value of a site's input is missing.
    """
    assert samples.f is not None
    f = np.asarray(samples.f[:, some])
    lacking = np.flatnonzero(np.all(np.isnan(f), axis=0))
    if len(lacking):
        site = int(np.arange(samples.sites)[some][lacking[0]])
        raise InputError(f"{samples.source}: the measured input of site {site + 1} is missing throughout")
    return np.asarray(replace(samples, u=np.zeros(f.shape), v=None, f=f).forcing()(times))
