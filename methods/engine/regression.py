"""The linear regression that most methods end in: one row per site, time and (real or imaginary) part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.derivatives import differentiate
from latticebench.methods.engine.scaled import lstsq
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
        """What a reader of the coefficients must know about the rows; "ok" where there is nothing."""
        if self.left_out:
            return f"{self.left_out} of {self.left_out + len(self.target)} rows left out: a term is not finite there"
        rank = int(np.linalg.matrix_rank(self.design / self.scales, tol=1e-12 * np.sqrt(self.design.size)))
        if rank < self.design.shape[1]:
            count = self.design.shape[1]
            return f"these data tell only {rank} of {count} terms apart; the coefficients are one choice of many"
        return "ok"

    @property
    def scales(self) -> Float[ndarray, " terms"]:
        """RMS of each column of A over that of y (terms,): xi * scales are the terms' shares of y; 1 where it is 0."""
        columns = np.sqrt(np.mean(self.design**2, axis=0))
        height = np.sqrt(np.mean(self.target**2))
        scale = columns / (height if height > 0 else 1.0)
        return np.where(scale > 0, scale, 1.0)

    def residual(self, coefficients: Float[ndarray, " terms"]) -> float:
        """Return the RMS of y - A xi over the RMS of y."""
        left = np.sqrt(np.mean((self.target - self.design @ coefficients) ** 2))
        height = np.sqrt(np.mean(self.target**2))
        return float(left / height) if height > 0 else float(left)

    def least_squares(self, support: ndarray | None = None) -> Float[ndarray, " terms"]:
        """Return the coefficients (terms,) that minimise |y - A xi|^2.

        Where the terms cannot be told apart, they are those of smallest norm on scaled columns.

        Args:
            support: which terms may differ from 0 (terms,); all of them when None.
        """
        chosen = np.arange(self.design.shape[1]) if support is None else np.flatnonzero(support)
        coefficients = np.zeros(self.design.shape[1])
        if len(chosen):
            scale = self.scales[chosen]
            coefficients[chosen] = lstsq(self.design[:, chosen], self.target, rcond=1e-14, scale=scale)
        return coefficients


def triangular(regression: Regression) -> Regression:
    """Return a regression with the same sums of squares in as few rows as columns, by the QR decomposition of [A y]."""
    if len(regression.target) <= regression.design.shape[1] + 1:
        return regression
    # On scaled columns, so that the units of a term do not matter.
    scale = np.append(regression.scales, 1.0)
    table = np.column_stack([regression.design, regression.target]) / scale
    triangle = np.asarray(np.linalg.qr(table, mode="r")) * scale
    return Regression(triangle[:, :-1], triangle[:, -1])


def rows(
    data: Sequence[Samples],
    library: Library,
    order: int,
    differentiation: str,
    options: Mapping[str, Any] | None = None,
) -> Regression:
    """Differentiate the samples and evaluate the library on them.

    For the second derivative an observed velocity is differentiated once; where none was observed, u twice.

    Args:
        data: the trajectories.
        library: the terms.
        order: of the time derivative.
        differentiation: see `methods.engine.derivatives`.
        options: further arguments of the differentiation.

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
    """Return the rows of one trajectory, without those that have a NaN.

    Args:
        samples: the trajectory: its times, input and ends.
        library: the terms.
        u: the field (T, N) on which they are evaluated.
        v: its velocity, or None.
        rate: the derivative to explain.
    """
    values = evaluate(library.terms, u, v, samples.f, samples.t, ends=samples.ends)
    inner = rate[:, observed(samples.sites, library.reach, samples.ends)]
    target = np.stack([inner.real, inner.imag] if samples.is_complex else [inner]).ravel()
    design = np.moveaxis(values, 1, -1).reshape(-1, len(library.terms))
    known = np.isfinite(target)
    whole = known & np.all(np.isfinite(design), axis=1)
    return Regression(
        design[whole], target[whole], int(np.sum(known) - np.sum(whole)) if not samples.has_missing else 0
    )
