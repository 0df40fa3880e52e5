"""The covariance of the weak equations of a chain, factored some sites at a time.

Equations share noise with those of the sites around them alone: in the order of the sites the covariance C is a band
matrix, and its Cholesky factor L has the same band. The factor of a block follows from the block's own part of C and,
of what came before, from the factor of the last few sites: what is left of C there when all before them is eliminated
is the product of that part of L with its transpose. One pass forwards gives rows with independent noise, L^-1 rows.
C^-1 rows needs a pass backwards, for which each block is made again from what was kept at its beginning. So no more
than one block is in memory, and the numbers are those of one factor for the whole chain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.regression import Regression, folded
from latticebench.methods.engine.weak_form import Slopes, WeakForm
from latticebench.systems.arrays import empty, rows_of

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# What is added to the diagonal of the covariance, as a share of itself, where rounding makes it not positive.
JITTERS = (0.0, 1e-13, 1e-11, 1e-9, 1e-7)


@dataclass(frozen=True, eq=False)
class _Whitened:
    """The equations of a block, linearised on the observed state about another.

    Attributes:
        slopes: derivatives of their residuals by the state.
        factor: lower band of the Cholesky factor of their covariance.
        rows: the terms and, in the last column, the left side, with independent noise of variance 1.
        lead: how many of the rows are those of the block before.
    """

    slopes: Slopes
    factor: Float[ndarray, "band rows"]
    rows: Float[ndarray, "rows terms_and_target"]
    lead: int


class Sweep:
    """The weak equations of a trajectory, linearised on the observed state about the state w.

    Args:
        form: the weak equations.
        w: the state that the terms are evaluated on (channels, coefficients).
        coefficients: xi.
        accuracy: standard deviation of the errors of quadrature and splines.
    """

    def __init__(self, form: WeakForm, w: ndarray, coefficients: ndarray, accuracy: float) -> None:
        self.form, self.w, self.coefficients, self.accuracy = form, w, coefficients, accuracy
        self._jitter = 0.0
        self._only: _Whitened | None = None
        shared, columns = form.shared * form.parts * form.count, len(form.library.terms) + 1
        # What a block passes on: the factor of its last sites, and their whitened rows.
        passed = len(form.cuts) - 2
        self._factors, self._rows = empty((passed, shared, shared)), empty((passed, shared, columns))

    def rows(self) -> Regression:
        """Return the whitened rows: those of a single block, or their triangular factor.

        Raises:
            FloatingPointError: a term is not finite.
            LinAlgError: the covariance is not positive.
        """
        for jitter in JITTERS:
            self._jitter = jitter
            try:
                return folded(self._pieces())
            except np.linalg.LinAlgError:
                continue
        raise np.linalg.LinAlgError("the covariance of the weak equations is not positive")

    def _pieces(self) -> Iterator[Regression]:
        for number in range(len(self.form.cuts) - 1):
            found = self._whitened(number)
            if len(self.form.cuts) == 2:
                self._only = found
            rows = found.rows[found.lead :]
            yield Regression(rows[:, :-1], rows[:, -1])

    def nearest(self, coefficients: Float[ndarray, " terms"]) -> Float[ndarray, "channels coefficients"]:
        """Return the state nearest to the observed one that obeys the linearised equations with new coefficients."""
        seen = self.form.state.seen
        found = empty(seen.shape)
        for some in rows_of(seen):
            found[some] = seen[some]
        pull = np.zeros(0)
        for number in reversed(range(len(self.form.cuts) - 1)):
            now = self._only or self._whitened(number)
            pull = _backwards(now.factor, now.rows[:, -1] - now.rows[:, :-1] @ coefficients, pull)
            now.slopes.draw(found, pull, now.lead // (self.form.parts * self.form.count))
            pull = pull[: now.lead]
        return found

    def _whitened(self, number: int) -> _Whitened:
        """Return the equations of a block, given what the one before passed on; pass on what the next one needs."""
        from scipy.linalg import cholesky_banded
        from scipy.linalg.lapack import dtbtrs

        form = self.form
        block = form.block(number)
        target, design = form.rows(self.w, block)
        slopes = form.slopes(self.w, self.coefficients, block)
        if not (np.all(np.isfinite(design)) and np.all(np.isfinite(slopes.matrix))):
            raise FloatingPointError("a term is not finite on the data")
        target += slopes.moved(form.state.seen[slopes.channel] - self.w[slopes.channel])
        rows = np.concatenate([design, target[..., None]], axis=-1).reshape(target.size, -1)
        band = _band(slopes, form.shared)
        band[0] = (band[0] + self.accuracy**2) * (1 + self._jitter)
        lead = block.lead * form.parts * form.count
        if lead:
            before = self._factors[number - 1]
            left = before @ before.T
            for column in range(lead):
                band[: lead - column, column] = left[column:, column]
            rows[:lead] = before @ self._rows[number - 1]
        factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        white = np.asarray(dtbtrs(factor, rows, uplo="L")[0])
        if number < len(self._rows):
            shared = self._rows.shape[1]
            self._factors[number], self._rows[number] = _last(factor, shared), white[len(white) - shared :]
        return _Whitened(slopes, factor, white, lead)


def _band(slopes: Slopes, shared: int) -> Float[ndarray, "band rows"]:
    """Return the lower band of the covariance of a block's equations, for unit noise of the state."""
    sites, reads = slopes.channel.shape
    size, coefficients = int(np.prod(slopes.matrix.shape[2:4])), slopes.matrix.shape[-1]
    matrix = slopes.matrix.reshape(sites * reads, size, coefficients)
    blocks = np.zeros((sites * (shared + 1), size, size))
    later, earlier = _pairs(slopes.channel)
    key = earlier // reads * (shared + 1) + later // reads - earlier // reads
    order = np.argsort(key, kind="stable")
    places, first, counts = np.unique(key[order], return_index=True, return_counts=True)
    for count in np.unique(counts):
        # All channels that two sites share at once.
        some = order[first[counts == count][:, None] + np.arange(count)]
        one, other = (
            matrix[read[some]].transpose(0, 2, 1, 3).reshape(len(some), size, -1) for read in (later, earlier)
        )
        blocks[places[counts == count]] = np.matmul(one, other.transpose(0, 2, 1))
    band = np.zeros((sites, size, (shared + 1) * size))
    blocks = blocks.reshape(sites, shared + 1, size, size)
    for column in range(size):
        band[:, column, : size - column] = blocks[:, 0, column:, column]
        for after in range(1, shared + 1):
            begin = after * size - column
            band[:, column, begin : begin + size] = blocks[:, after, :, column]
    return band.reshape(sites * size, -1).T


def _pairs(channel: Int[ndarray, "sites reads"]) -> tuple[Int[ndarray, " pairs"], Int[ndarray, " pairs"]]:
    """Return all pairs of numbers in `channel` that are the same, of a site with itself or an earlier one."""
    reads, flat = channel.shape[1], channel.ravel()
    order = np.argsort(flat, kind="stable")
    later, earlier = [], []
    for lag in range(len(order)):
        one, other = order[lag:], order[: len(order) - lag]
        same = flat[one] == flat[other]
        if not np.any(same):
            break
        later.append(one[same])
        earlier.append(other[same])
        if lag:
            # Both orders count where one site reads a channel twice, which it does at an end.
            twice = same & (one // reads == other // reads)
            later.append(other[twice])
            earlier.append(one[twice])
    return np.concatenate(later), np.concatenate(earlier)


def _last(factor: Float[ndarray, "band rows"], size: int) -> Float[ndarray, "last last"]:
    """Return the part of a factor that belongs to its last rows."""
    last = np.zeros((size, size))
    for column in range(size):
        last[column:, column] = factor[: size - column, factor.shape[1] - size + column]
    return last


def _backwards(factor: ndarray, right: Float[ndarray, " rows"], known: Float[ndarray, " last"]) -> ndarray:
    """Solve L^T x = right, where the last of x are known from the block that follows."""
    from scipy.linalg.lapack import dtbtrs

    if len(known):
        right = right.copy()
        right[len(right) - len(known) :] = _last(factor, len(known)).T @ known
    return np.asarray(dtbtrs(factor, right, uplo="L", trans="T")[0])
