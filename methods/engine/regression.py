"""The linear regression that most methods end in: one row per site, time and (real or imaginary) part."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.derivatives import differentiator
from latticebench.methods.engine.scaled import lstsq
from latticebench.systems.arrays import PIECE, rows_of
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Stencil, Window, evaluate

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
        count: how many rows they stand for, with the same sums of squares and products; None for themselves.
    """

    design: Float[ndarray, "rows terms"]
    target: Float[ndarray, " rows"]
    left_out: int = 0
    count: int | None = None

    @property
    def size(self) -> int:
        """The number of rows, or of those that they stand for."""
        return len(self.target) if self.count is None else self.count

    @property
    def height(self) -> float:
        """RMS of y."""
        return float(_rms(self.target) * np.sqrt(len(self.target) / self.size))

    @property
    def status(self) -> str:
        """What a reader of the coefficients must know about the rows; "ok" where there is nothing."""
        if self.left_out:
            return f"{self.left_out} of {self.left_out + self.size} rows left out: a term is not finite there"
        count = self.design.shape[1]
        # Of columns of RMS 1, whatever the unit of y.
        scaled = self.design / (self.scales * (self.height or 1.0))
        rank = int(np.linalg.matrix_rank(scaled, tol=1e-12 * np.sqrt(self.size * count)))
        if rank < count:
            return f"these data tell only {rank} of {count} terms apart; the coefficients are one choice of many"
        return "ok"

    @property
    def scales(self) -> Float[ndarray, " terms"]:
        """RMS of each column of A over that of y (terms,): xi * scales are the terms' shares of y; 1 where it is 0."""
        scale = _rms(self.design) * np.sqrt(len(self.target) / self.size) / (self.height or 1.0)
        return np.where(scale > 0, scale, 1.0)

    def residual(self, coefficients: Float[ndarray, " terms"]) -> float:
        """Return the RMS of y - A xi over the RMS of y."""
        left = replace(self, target=self.target - self.design @ coefficients).height
        return left / (self.height or 1.0)

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


def _rms(values: ndarray) -> ndarray:
    """Return the RMS along the first axis; a power of 2 is taken out, so that no square overflows."""
    _, exponent = np.frexp(np.max(np.abs(values), axis=0, initial=0.0))
    unit = np.ldexp(1.0, exponent - 1)
    return np.asarray(unit * np.sqrt(np.mean((values / unit) ** 2, axis=0)))


def triangular(regression: Regression) -> Regression:
    """Return a regression with the same sums of squares in as few rows as columns, by the QR decomposition of [A y]."""
    if len(regression.target) <= regression.design.shape[1] + 1:
        return regression
    # On scaled columns, so that the units of a term do not matter.
    scale = np.append(regression.scales, 1.0)
    table = np.column_stack([regression.design, regression.target]) / scale
    triangle = np.asarray(np.linalg.qr(table, mode="r")) * scale
    return Regression(triangle[:, :-1], triangle[:, -1])


def folded(pieces: Iterable[Regression]) -> Regression:
    """Return one regression with the sums of squares and products of all pieces.

    It is the triangular factor of the QR decomposition of [A y], taken piece by piece, so that no more than one piece
    is in memory and the conditioning is not squared, as it is in normal equations (TSQR: Demmel, Grigori, Hoemmen &
    Langou, SIAM J. Sci. Comput. 34, A206 (2012)). A single piece is returned as it is.

    All that depends on A and y by way of |y - A xi| is the same for the factor as for the rows: least squares on any
    support, and so STLSQ, SR3, SSR and FROLS.
    """
    whole = functools.reduce(joined, pieces, None)
    assert whole is not None
    return whole


def joined(whole: Regression | None, piece: Regression) -> Regression:
    """Return one regression with the sums of two; the piece itself where there is nothing yet."""
    if whole is None:
        return piece
    first = triangular(whole)
    both = Regression(np.concatenate([first.design, piece.design]), np.concatenate([first.target, piece.target]))
    return replace(triangular(both), left_out=whole.left_out + piece.left_out, count=whole.size + piece.size)


def rows(
    data: Sequence[Samples],
    library: Library,
    order: int,
    differentiation: str,
    options: Mapping[str, Any] | None = None,
) -> Regression:
    """Return all rows of `row_pieces`."""
    parts = list(row_pieces(data, library, order, differentiation, options))
    if len(parts) == 1:
        return parts[0]
    design, target = (np.concatenate([getattr(one, name) for one in parts]) for name in ("design", "target"))
    return Regression(design, target, sum(one.left_out for one in parts))


def sums(
    data: Sequence[Samples],
    library: Library,
    order: int,
    differentiation: str,
    options: Mapping[str, Any] | None = None,
) -> Regression:
    """Return `row_pieces` folded into one regression with the same sums; no more than one piece is in memory."""
    return folded(row_pieces(data, library, order, differentiation, options))


def row_pieces(
    data: Sequence[Samples],
    library: Library,
    order: int,
    differentiation: str,
    options: Mapping[str, Any] | None = None,
) -> Iterator[Regression]:
    """Differentiate the samples and evaluate the library on them, on some neighbouring sites after others.

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
    count, left_out, highest = 0, 0, 0.0
    for samples in data:
        stencil = Stencil.chain(samples.sites, library.reach, samples.ends)
        most = max(1, PIECE // (len(samples.t) * len(library.terms) * (1 + samples.is_complex)))
        try:
            with np.errstate(all="ignore"):
                curves = _curves(samples, order, differentiation, options)
            for window in stencil.windows(most):
                with np.errstate(all="ignore"):
                    u, v, rate = curves(window.columns)
                piece = assemble(samples, library, u, v, rate, window)
                count, left_out = count + piece.size, left_out + piece.left_out
                highest = max(highest, float(np.max(np.abs(piece.target), initial=0.0)))
                yield piece
        except (InputError, np.linalg.LinAlgError) as error:
            raise InputError(f"{samples.source}: {error}") from None
    if count == 0 and left_out:
        raise InputError(
            f"{data[0].source}: in every row a term of the library is not finite; are the values too large for it?"
        )
    if count == 0:
        raise InputError(
            f"{data[0].source}: no sample has its whole stencil; there are too many missing values or too few sites"
        )
    size = max(float(np.nanmax(np.abs(samples.u[some]))) for samples in data for some in rows_of(samples.u))
    step = min(float(np.min(np.diff(samples.t))) for samples in data)
    if highest <= ROUND_OFF * size / step**order:
        raise InputError(f"{data[0].source}: nothing moves: the derivative is round-off; there is no motion to fit")


def _curves(
    samples: Samples, order: int, differentiation: str, options: Mapping[str, Any] | None
) -> Callable[[slice | ndarray], tuple[ndarray, ndarray | None, ndarray]]:
    """Return a function of some sites that gives u and v there, and the derivative to explain."""
    field = differentiator(samples.t, samples.u, differentiation, options)
    measured = samples.v
    if order == 1 or measured is None:

        def by_field(some: slice | ndarray) -> tuple[ndarray, ndarray | None, ndarray]:
            u = field(samples.u[:, some])
            return (u.value, None, u.first) if order == 1 else (u.value, u.first, u.second)

        return by_field
    velocity = differentiator(samples.t, measured, differentiation, options)

    def by_velocity(some: slice | ndarray) -> tuple[ndarray, ndarray | None, ndarray]:
        v = velocity(measured[:, some])
        return field(samples.u[:, some]).value, v.value, v.first

    return by_velocity


def assemble(
    samples: Samples,
    library: Library,
    u: ndarray,
    v: ndarray | None,
    rate: Float[ndarray, "time sites"],
    window: Window | None = None,
) -> Regression:
    """Return the rows of one trajectory, without those that have a NaN.

    Args:
        samples: the trajectory: its times, input and ends.
        library: the terms.
        u: the field (T, N) on which they are evaluated; with a window, on its columns alone, as v and rate.
        v: its velocity, or None.
        rate: the derivative to explain.
        window: the sites whose rows are asked for; None for all.
    """
    if window is None:
        window = next(Stencil.chain(samples.sites, library.reach, samples.ends).windows(samples.sites))
    f = None if samples.f is None else samples.f[:, window.columns]
    values = evaluate(library.terms, u, v, f, samples.t, ends=samples.ends, window=window)
    inner = rate[:, window.own]
    target = np.stack([inner.real, inner.imag] if samples.is_complex else [inner]).ravel()
    design = np.moveaxis(values, 1, -1).reshape(-1, len(library.terms))
    known = np.isfinite(target)
    whole = known & np.all(np.isfinite(design), axis=1)
    return Regression(
        design[whole], target[whole], int(np.sum(known) - np.sum(whole)) if not samples.has_missing else 0
    )
