"""A measured input at times other than those of its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


def inputs(samples: Samples, times: Float[ndarray, " time"]) -> Float[ndarray, "time sites"]:
    """Return the measured input at other times, as `Samples.forcing` has it: every method has the same.

    Raises:
        InputError: every value of a site's input is missing.
    """
    return np.asarray(samples.forcing()(times))
