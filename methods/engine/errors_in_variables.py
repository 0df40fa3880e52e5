"""Generalised least squares for the weak form, with errors in the variables, and the selection of terms.

The weak equations are whitened by the covariance of their residual (`latticebench.methods.engine.weak_form`).
Generalised least squares then gives the coefficients, and the same algebra gives the nearest state that obeys the weak
equations; there the terms are evaluated again, until nothing changes. This is Gauss-Newton for maximum likelihood with
errors in the variables (Britt & Luecke, Technometrics 15, 233 (1973)). It removes the bias that noise causes in plain
least squares, such as 3 sigma^2 u in u^3.

Terms are selected on the whitened rows: the least significant term is removed, again and again, and the extended
Bayesian information criterion (Chen & Chen, Biometrika 95, 759 (2008)) decides how many stay.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.regression import Regression, folded, joined, triangular
from latticebench.methods.engine.scaled import Scaled
from latticebench.methods.engine.weak_covariance import Sweep
from latticebench.methods.engine.weak_form import ACCURACY, WeakForm
from latticebench.systems.arrays import empty, rows_of
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

# Largest number of times that the terms are evaluated anew.
ROUNDS = 20
# Draws of the noise for total least squares, and the mean square residual above which it is used.
DRAWS = 10
SUSPECT = 1.5
# Estimates are as good as each other where the logarithms of their mean square residuals differ by no more than this.
ALIKE = 1e-3


@dataclass(frozen=True, eq=False)
class Estimate:
    """Coefficients by generalised least squares, with the rows that they come from and the states that go with them.

    Attributes:
        coefficients: (terms,); 0 outside the support.
        stderr: their standard errors, widened where the residual is larger than the noise explains.
        regression: the whitened rows of all terms, or as few that have the same sums of squares.
        chi2: mean square of the whitened residual, about 1 when the equation holds and the noise is known.
        sweeps: the linearised equations of each trajectory that they come from.
        rounds: how many times the terms were evaluated.
        settled: whether the coefficients stopped changing.
    """

    coefficients: Float[ndarray, " terms"]
    stderr: Float[ndarray, " terms"]
    regression: Regression
    chi2: float
    sweeps: tuple[Sweep, ...]
    rounds: int
    settled: bool

    @functools.cached_property
    def states(self) -> tuple[Float[ndarray, "channels coefficients"], ...]:
        """The state w of each trajectory that goes with the coefficients."""
        return tuple(sweep.nearest(self.coefficients) for sweep in self.sweeps)


def estimate(
    forms: Sequence[WeakForm],
    support: Bool[ndarray, " terms"],
    rounds: int,
    start: Estimate | None = None,
    seed: int = 0,
) -> Estimate:
    """Alternate between the coefficients of the terms in `support` and the states until neither changes.

    Without `start`, the iteration begins with ordinary least squares and, where that fails because noise pulls it to
    zero, with total least squares. The iteration that settles is kept; of two that settle, the one whose residual the
    noise explains better.

    Args:
        forms: the weak equations of each trajectory.
        support: which terms are fitted.
        rounds: largest number of times that the terms are evaluated.
        start: an estimate to begin with.
        seed: of the draws from which total least squares takes the noise of the rows.

    Raises:
        InputError: the covariance is not positive, or the terms overflow.
    """
    if start is not None:
        return _iterate(forms, support, rounds, np.where(support, start.coefficients, 0.0), start.states)
    seen = tuple(form.state.seen for form in forms)
    first = folded(_checked(forms)).least_squares(support)
    found = _iterate(forms, support, rounds, first, seen)
    if found.settled and found.chi2 < SUSPECT:
        return found
    second = _total(forms, support, seed)
    if second is None:
        return found
    other = _iterate(forms, support, rounds, second, seen)
    if other.settled != found.settled:
        return other if other.settled else found
    # Both may have come to the same: rounding must not choose.
    first, last = (abs(np.log(max(one.chi2, 1e-300))) for one in (found, other))
    return other if last < first - ALIKE else found


def _iterate(
    forms: Sequence[WeakForm], support: ndarray, rounds: int, coefficients: ndarray, states: Sequence[ndarray]
) -> Estimate:
    sizes = [len(form.sites) * form.parts * form.count for form in forms]
    height = np.sqrt(np.average([form.height**2 for form in forms], weights=sizes))
    accuracy = ACCURACY * (float(height) or 1.0)
    best: Estimate | None = None
    for number in range(1, rounds + 1):
        try:
            now = _round(forms, support, coefficients, states, accuracy, number)
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            if best is None:
                raise InputError(f"{forms[0].samples.source}: the weak form fails: {error}") from error
            return best
        step = np.abs(now.coefficients - coefficients)
        tolerance = np.maximum(0.01 * now.stderr, 1e-13 * np.max(np.abs(now.coefficients), initial=0.0))
        # The last estimate is kept, unless the iteration ran away from a better one.
        if best is None or now.chi2 <= 1.2 * best.chi2:
            best = now
        if np.all(step <= tolerance):
            return replace(best, settled=True)
        coefficients = now.coefficients
        if number < rounds:
            states = now.states
    assert best is not None
    return best


def _total(forms: Sequence[WeakForm], support: ndarray, seed: int) -> ndarray | None:
    """Return the coefficients by total least squares; None where it has no finite solution.

    Noise in the terms pulls ordinary least squares towards zero, but not total least squares, which makes [A, y] (xi,
    -1) small against the contribution of the noise, taken from a few draws (Van Huffel & Vandewalle, The Total Least
    Squares Problem, SIAM 1991, chapter 8). With the triangular factors R of [A, y] and N of its changes by noise, that
    is R^-1 z, where z is the right singular vector of N R^-1 that belongs to the largest singular value. Sums of
    squares would square the conditioning.
    """
    draw = np.random.default_rng(seed)
    changes: Regression | None = None
    for form in forms:
        noisy = empty(form.state.seen.shape)
        for _ in range(DRAWS):
            for some in rows_of(noisy):
                noisy[some] = form.state.seen[some] + draw.normal(size=noisy[some].shape)
            for rows, other in zip(form.pieces(form.state.seen), form.pieces(noisy), strict=True):
                changes = joined(changes, Regression((other - rows)[:, :-1][:, support], (other - rows)[:, -1]))
    assert changes is not None
    pieces = (
        Regression(rows[:, :-1][:, support], rows[:, -1]) for form in forms for rows in form.pieces(form.state.seen)
    )
    factor, noise = (np.column_stack([one.design, one.target]) for one in map(triangular, (folded(pieces), changes)))
    if len(factor) < factor.shape[1]:
        return None
    scale = np.linalg.norm(factor, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    try:
        modes = np.linalg.svd(np.linalg.solve((factor / scale).T, (noise / scale).T).T)[2]
        least = np.linalg.solve(factor / scale, modes[0])
    except np.linalg.LinAlgError:
        return None
    if not abs(least[-1]) >= 1e-6 * np.max(np.abs(least)):
        return None
    full = np.zeros(len(support))
    full[support] = -least[:-1] / scale[:-1] / (least[-1] / scale[-1])
    return full


def _checked(forms: Sequence[WeakForm]) -> Iterator[Regression]:
    """Yield the rows of the integrals on the observed states."""
    for form in forms:
        for rows in form.pieces(form.state.seen):
            if not np.all(np.isfinite(rows)):
                raise InputError(f"{form.samples.source}: the weak form fails: a term is not finite on the data")
            yield Regression(rows[:, :-1], rows[:, -1])


def _round(
    forms: Sequence[WeakForm],
    support: ndarray,
    coefficients: ndarray,
    states: Sequence[ndarray],
    accuracy: float,
    number: int,
) -> Estimate:
    """Linearise about the states and coefficients, and solve for the coefficients."""
    sweeps = tuple(Sweep(form, w, coefficients, accuracy) for form, w in zip(forms, states, strict=True))
    regression = folded(sweep.rows() for sweep in sweeps)
    found = regression.least_squares(support)
    left = regression.target - regression.design @ found
    chi2 = float(np.sum(left**2) / max(regression.size - np.sum(support), 1))
    stderr = np.zeros(len(found))
    stderr[support] = Scaled.of(regression.design[:, support]).stderr() * np.sqrt(max(chi2, 1.0))
    return Estimate(found, stderr, regression, chi2, sweeps, number, settled=False)


def eliminate(
    regression: Regression, support: Bool[ndarray, " terms"], variance: float, gamma: float = 1.0
) -> Bool[ndarray, " terms"]:
    """Remove the least significant term, again and again, and return the support with the least information criterion.

    The criterion is |y - A xi|^2 / variance + k (log n + 2 gamma log p), for k of p terms and n rows (Chen & Chen
    2008).

    Args:
        regression: whitened rows.
        support: the terms to begin with.
        variance: of the rows.
        gamma: 0 for the Bayesian information criterion, 1 for its extension to large libraries.
    """
    design, target = regression.design, regression.target
    terms = design.shape[1]
    price = np.log(regression.size) + 2 * gamma * np.log(terms)
    # The triangular factor has the same sums of squares in few rows.
    scale = np.linalg.norm(design, axis=0)
    scaled = np.column_stack([design / np.where(scale > 0, scale, 1.0), target])
    triangle = np.asarray(np.linalg.qr(scaled, mode="r"))
    columns, right = triangle[:, :-1], triangle[:, -1]
    left: ndarray = np.flatnonzero(support)
    best, best_score = np.zeros(terms, dtype=bool), float("inf")
    while True:
        solution = np.linalg.lstsq(columns[:, left], right, rcond=1e-14)[0] if len(left) else np.zeros(0)
        score = float(np.sum((right - columns[:, left] @ solution) ** 2)) / variance + price * len(left)
        if score < best_score:
            best = np.isin(np.arange(terms), left)
            best_score = score
        if len(left) == 0:
            return best
        z = np.abs(solution) / Scaled.of(columns[:, left]).stderr()
        left = np.delete(left, int(np.argmin(z)))


Selection = Callable[[Estimate, "ndarray"], "ndarray"]


def by_criterion(found: Estimate, support: Bool[ndarray, " terms"]) -> Bool[ndarray, " terms"]:
    """Select terms by the extended Bayesian information criterion."""
    return eliminate(found.regression, support, max(found.chi2, 1.0))


def sparse_estimate(
    forms: Sequence[WeakForm], rounds: int = ROUNDS, seed: int = 0, select: Selection | None = by_criterion
) -> tuple[Estimate, Bool[ndarray, " terms"]]:
    """Estimate all coefficients, select terms, and estimate the coefficients of the terms that stay.

    Args:
        forms: the weak equations of each trajectory.
        rounds: largest number of times that the terms are evaluated per estimate.
        seed: see `estimate`.
        select: function that maps an estimate and its support to a smaller support; None to keep every term.

    Returns:
        the estimate, and its support.

    Raises:
        InputError: see `estimate`.
    """
    support = np.ones(len(forms[0].library.terms), dtype=bool)
    found = estimate(forms, support, rounds, seed=seed)
    if select is None:
        return found, support
    # The second pass judges with the covariance of the selected terms alone.
    for _ in range(2):
        chosen = select(found, support)
        if np.array_equal(chosen, support):
            break
        support = chosen
        found = estimate(forms, support, rounds, found)
    return found, support
