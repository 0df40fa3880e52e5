"""The linear regression that most methods end in: one row a site, time and (real or imaginary) part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.derivatives import differentiate
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import evaluate, observed

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A derivative below this share of field over step is made of round-off.
ROUND_OFF = 1e-12


@dataclass(frozen=True, eq=False)
class Regression:
    """The rows A xi = y, in the units of the derivative.

    Attributes:
        design: A, the terms' values (rows, terms).
        target: y, the derivative of order 1 or 2 (rows,).
        left_out: rows whose derivative is known but one of whose terms is not finite.
    """

    design: Float[ndarray, "rows terms"]
    target: Float[ndarray, " rows"]
    left_out: int = 0

    @property
    def status(self) -> str:
        """Say "ok", or what a reader of the coefficients must know of the rows."""
        if self.left_out:
            return f"{self.left_out} of {self.left_out + len(self.target)} rows left out: a term is not finite there"
        rank = int(np.linalg.matrix_rank(self.design / self.scales, tol=1e-12 * np.sqrt(self.design.size)))
        if rank < self.design.shape[1]:
            return f"these data tell only {rank} of {self.design.shape[1]} terms apart; the coefficients are one choice of many"
        return "ok"

    @property
    def scales(self) -> Float[ndarray, " terms"]:
        """RMS of each column of A over that of y, so that xi * scales is each term's share; 1 where that is 0."""
        columns = np.sqrt(np.mean(self.design**2, axis=0))
        height = np.sqrt(np.mean(self.target**2))
        scale = columns / (height if height > 0 else 1.0)
        return np.where(scale > 0, scale, 1.0)

    def residual(self, coefficients: Float[ndarray, " terms"]) -> float:
        """RMS of y - A xi over the RMS of y."""
        left = np.sqrt(np.mean((self.target - self.design @ coefficients) ** 2))
        height = np.sqrt(np.mean(self.target**2))
        return float(left / height) if height > 0 else float(left)

    def least_squares(self, support: ndarray | None = None) -> Float[ndarray, " terms"]:
        """Solve by least squares, on the terms in `support` alone when it is given (the others are 0).

        The smallest-norm solution, on scaled columns, where the terms cannot be told apart.
        """
        chosen = np.arange(self.design.shape[1]) if support is None else np.flatnonzero(support)
        coefficients = np.zeros(self.design.shape[1])
        if len(chosen):
            scale = self.scales[chosen]
            solution = np.linalg.lstsq(self.design[:, chosen] / scale, self.target, rcond=1e-14)[0]
            coefficients[chosen] = solution / scale
        return coefficients


def rows(
    data: Sequence[Samples],
    library: Library,
    order: int,
    differentiation: str,
    options: Mapping[str, Any] | None = None,
) -> Regression:
    """Differentiate the samples and evaluate the library on them.

    A velocity that was observed is differentiated once for the second derivative; one that was not is the first derivative of u.

    Raises:
        InputError: the differentiation fails, or no row is complete.
    """
    designs, targets = [], []
    left_out = 0
    for samples in data:
        try:
            with np.errstate(all="ignore"):
                u = differentiate(samples.t, samples.u, differentiation, options)
                if order == 1:
                    v, rate = None, u.first
                elif samples.v is None:
                    v, rate = u.first, u.second
                else:
                    measured = differentiate(samples.t, samples.v, differentiation, options)
                    v, rate = measured.value, measured.first
        except (InputError, np.linalg.LinAlgError) as error:
            raise InputError(f"{samples.source}: {error}") from None
        one = assemble(samples, library, u.value, v, rate)
        designs.append(one.design)
        targets.append(one.target)
        left_out += one.left_out
    design, target = np.concatenate(designs), np.concatenate(targets)
    if len(target) == 0 and left_out:
        raise InputError(
            f"{data[0].source}: in every row a term of the library is not finite; are the values too large for it?"
        )
    if len(target) == 0:
        raise InputError(
            f"{data[0].source}: no sample has its whole stencil; there are too many missing values or too few sites"
        )
    size = max(float(np.nanmax(np.abs(samples.u))) for samples in data)
    step = min(float(np.min(np.diff(samples.t))) for samples in data)
    if np.max(np.abs(target)) <= ROUND_OFF * size / step**order:
        raise InputError(f"{data[0].source}: nothing moves: the derivative is round-off; there is no motion to fit")
    return Regression(design, target, left_out)


def assemble(
    samples: Samples, library: Library, u: ndarray, v: ndarray | None, rate: Float[ndarray, "time sites"]
) -> Regression:
    """Make the rows of one trajectory from its state and the derivative to explain; rows with NaN are left out."""
    values = evaluate(library.terms, u, v, samples.f, samples.t, ends=samples.ends)
    inner = rate[:, observed(samples.sites, library.reach, samples.ends)]
    target = np.stack([inner.real, inner.imag] if samples.is_complex else [inner]).ravel()
    design = np.moveaxis(values, 1, -1).reshape(-1, len(library.terms))
    known = np.isfinite(target)
    whole = known & np.all(np.isfinite(design), axis=1)
    return Regression(
        design[whole], target[whole], int(np.sum(known) - np.sum(whole)) if not samples.has_missing else 0
    )
