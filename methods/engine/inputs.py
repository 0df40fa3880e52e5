"""A measured input at times other than those of its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


def inputs(samples: Samples, times: Float[ndarray, " time"]) -> Float[ndarray, "time sites"]:
    """Interpolate the measured input, site by site, by cubic splines (by lines where fewer than four values were seen).

    Args:
        samples: a trajectory with a measured input f.
        times: where to interpolate (P,).

    Raises:
        InputError: every value of a site's input is missing.
    """
    from scipy.interpolate import make_interp_spline

    assert samples.f is not None
    result = np.empty((len(times), samples.sites))
    for site in range(samples.sites):
        seen = np.isfinite(samples.f[:, site])
        if not np.any(seen):
            raise InputError(f"{samples.source}: every value of the input f{site + 1} is missing")
        degree = 3 if np.sum(seen) > 3 else min(1, int(np.sum(seen)) - 1)
        result[:, site] = make_interp_spline(samples.t[seen], samples.f[seen, site], k=degree)(times)
    return result
