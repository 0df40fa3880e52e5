"""A bound that can be asked for more samples; that of recordings, along the motion of a fit; a fit's covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench import methods
from latticebench.bench.limit import Limit, bound_along, denser
from latticebench.bench.noise import left_by
from latticebench.bench.report.units import in_words, of_coefficients, units_of
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.methods.method import solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.method import Fit

# A bound for so many times the samples in the same time, and for a record so many times as long.
BoundAt = Callable[[int, int], Limit]


@dataclass(frozen=True, eq=False)
class BoundOf:
    """The bound of some samples, of as many again, and of longer records.

    Attributes:
        at: the bound.
        note: where it is taken, and the noise of each sensor, one line each.
        warnings: why it may not hold.
        units: of the coefficients; empty where none is known.
    """

    at: BoundAt
    note: str
    warnings: tuple[str, ...]
    units: tuple[str, ...] = ()


def of_recordings(data: Sequence[Samples], candidates: Library, order: int) -> BoundOf:
    """Fit recordings by the method that gives the motion it follows, and return the bound along that.

    Raises:
        Skipped: the method cannot take the recordings.
        InputError: the equation cannot be set up on them.
    """
    method = next(kind() for kind in methods.registered().values() if kind().abilities.motion)
    fit = solve(method, data, candidates, order, 1)
    left = left_by(data, fit)

    def bound_at(more: int, longer: int) -> Limit:
        if longer > 1:
            raise InputError("nobody knows how the motion goes on after the record")
        return denser(data, fit, more, left.noise)

    note = (
        f"{data[0].source}: bound along the motion that {fit.method!r} fits to the samples, with the noise that it "
        "leaves" + ("" if fit.status == "ok" else f" ({fit.status})")
    )
    units = units_of(data[0].origin)
    told = in_words(units)
    lines = [note, *(f"noise of {line}" for line in left.lines), *([f"units: {told}"] if told else [])]
    return BoundOf(bound_at, "\n".join(lines), left.warning, tuple(of_coefficients(candidates.terms, order, units)))


def covariance_of_fit(data: Sequence[Samples], fit: Fit) -> Float[ndarray, "terms terms"]:
    """Return the covariance of a fit's coefficients, with the standard errors that its method gives.

    The correlations are those of the maximum-likelihood estimate with white noise, which are those of the Cramer-Rao
    bound along the fitted motion. Terms without a standard error have 0.

    Raises:
        InputError: the method follows no motion, or gives no standard errors.
    """
    if fit.motion is None or fit.stderr is None:
        raise InputError(f"method {fit.method!r} gives no covariance; fit with 'trajectory'")
    kept = np.flatnonzero(fit.stderr > 0)
    chosen = Library(fit.library.name, tuple(fit.library.terms[k] for k in kept))
    sizes = [float(fit.found[name]) for name in ("noise_u", "noise_v") if name in fit.found]
    size = np.repeat(sizes, data[0].sites)
    noise = Noise(size, 0.0, np.inf, np.zeros(len(size)), Structure())
    found = bound_along(data, fit.motion, chosen, fit.order, fit.coefficients[kept], noise=noise)
    error = (fit.stderr[kept] / found.stderr)[:, None]
    covariance = np.zeros((len(fit.stderr),) * 2)
    covariance[np.ix_(kept, kept)] = found.covariance * error * error.T
    return covariance
