"""Maximum likelihood for a model over pieces: damped Gauss-Newton steps, with the noise of each sensor estimated along.

The initial state of each piece is eliminated from the normal equations piece by piece; the numbers of the model remain.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Chain
from latticebench.diagnosis.horizon import Followed, Layout, Path, fields, follow, linearised
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Noise, Structure, Whitener
from latticebench.diagnosis.noise_estimate import SPARE, estimate
from latticebench.diagnosis.normal import UNDETERMINED, by_pieces, normal, scaled_inverse
from latticebench.diagnosis.rows import Rows

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A fit ends where a step promises or wins fewer nats.
ENOUGH = 0.05
# So many first steps are taken whatever they promise: far away little can be foreseen.
BLIND = 2
# Damping of the first step, the factors after a step that failed and one that did not, and how often one may fail.
DAMPING, MORE, LESS, MOST_FAILURES = 1e-6, 30.0, 0.1, 5
# A line of the spectrum stands so many times above the mean; one of noise does with a chance of exp(-LINE).
LINE = 20.0
# Of a sum of squares at least this share is left whatever takes it away: scores are linear.
MOST_TAKEN = 1e-6


def whitened(followed: Followed, noise: Noise, rows: Rows) -> tuple[Whitener, ndarray, ndarray, ndarray]:
    """Return the whitener, what is left and its derivatives in independent numbers, and the robust weights' roots."""
    seen = np.isfinite(followed.left)
    whitener = noise.whitener(followed.swing, rows, seen)
    error = whitener.apply(np.where(seen, followed.left, 0.0))
    robust = whitener.robust(error)
    return whitener, error * robust, whitener.apply(followed.slope) * robust[..., None], robust


@dataclass(frozen=True, eq=False)
class Curve:
    """What a model makes of one recording, at its rows in order.

    Attributes:
        t: times (T,).
        seen: readings (T, levels, parts, N), NaN where nothing was read or the site has no equation.
        level: what the instruments read of the motion, likewise.
        field: the motion (T, order, parts, N).
    """

    t: Float[ndarray, " time"]
    seen: Float[ndarray, "time levels parts sites"]
    level: Float[ndarray, "time levels parts sites"]
    field: Float[ndarray, "time order parts sites"]

    @property
    def swing(self) -> Float[ndarray, "time levels parts sites"]:
        """The level about its mean, with which noise may grow; NaN where there is no level."""
        known = np.isfinite(self.level)
        mean = np.sum(self.level, axis=0, where=known) / np.maximum(np.sum(known, axis=0), 1)
        return np.asarray(self.level - mean)


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model fitted to pieces.

    Attributes:
        layout: the pieces.
        followed: the model along them.
        noise: of every sensor.
        cost: minus the log likelihood times the share of readings that the curves of sites without an equation leave
            free (where these follow the noise, none is left to compare models by), and the noise's `price`; in nats.
        covariance: of the model's numbers, with what the model misfits.
        dispersion: by how much likelihood ratios are too large, as what is left is no noise; see `Normal.dispersion`.
        converged: whether the steps came to an end.
        rows: times and sensors of the readings.
        curved: numbers of the curves of the sites without an equation, of each sensor.
    """

    layout: Layout
    followed: Path
    noise: Noise
    cost: float
    covariance: Float[ndarray, "numbers numbers"]
    dispersion: float
    converged: bool
    rows: Rows
    curved: Float[ndarray, " sensors"]

    @property
    def model(self) -> Model:
        """The model with its numbers."""
        return self.followed.model

    @property
    def information(self) -> float:
        """Half of Akaike's criterion, in nats, by which fits are compared whose curves have other numbers."""
        taken = float(np.sum(self.curved))
        return self.cost / left_free(1.0, taken / max(self.layout.readings(), 1)) + taken

    @property
    def least(self) -> Float[ndarray, " sensors"]:
        """The smallest variance that the noise of each sensor may have, in units of the one that was found."""
        return np.asarray((self.rows.least / self.noise.size) ** 2)

    def linearised(self) -> Followed:
        """Return the derivatives of the motion, computed anew: they take as much memory as hundreds of motions."""
        found = linearised(self.followed, self.layout)
        assert found is not None, "a fit ends where they are finite"
        return found

    @property
    def chain(self) -> Chain:
        """The lattice."""
        return self.layout.chain

    @property
    def pieces(self) -> int:
        """Pieces that it was followed over, of all recordings."""
        return self.layout.pieces

    @property
    def longest(self) -> int:
        """Samples of the longest piece."""
        return self.layout.longest

    @property
    def stderr(self) -> Float[ndarray, " numbers"]:
        """Standard errors of the model's numbers."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @functools.cached_property
    def left(self) -> Float[ndarray, "rows channels"]:
        """Readings less what the model says and less the zeros that wander, as far as these are known."""
        return self.noise.still(self.followed.left, self.followed.swing, self.rows)

    def zeros(self, number: int) -> Float[ndarray, "levels parts sites"]:
        """Return where the zeros that wander are last known to be in a recording, 0 for all others."""
        begin = sum(rows.size for rows in self.layout.rows[:number])
        here = slice(begin, begin + self.layout.rows[number].size)
        walk = (self.followed.left - self.left)[here]
        chain = self.chain
        last = [column[np.isfinite(column)][-1:] for column in walk.T]
        return np.array([np.sum(one) for one in last]).reshape(chain.levels, chain.parts, chain.sites)

    @property
    def rms(self) -> Float[ndarray, " sensors"]:
        """Root mean square of what is left at each sensor, in units of the readings; NaN where nothing was read."""
        sensors = int(np.max(self.rows.sensor)) + 1
        squares = [self.left[:, self.rows.sensor == k] ** 2 for k in range(sensors)]
        return np.array([np.sqrt(np.nanmean(one)) if np.any(np.isfinite(one)) else np.nan for one in squares])

    def has_lines(self) -> bool:
        """Return whether what is left stands or swings at some frequency: a misfit does; noise, correlated or not, not.

        Single outliers count as little as in the fit.
        """
        seen = np.isfinite(self.followed.left)
        whitener = self.noise.whitener(self.followed.swing, self.rows, seen)
        error = whitener.apply(np.where(seen, self.followed.left, 0.0))
        for column, read in zip((error * whitener.robust(error)).T, seen.T, strict=True):
            # A sensor that was never read has no spectrum.
            if not np.any(read):
                continue
            power = np.abs(np.fft.rfft(column[read])) ** 2
            if np.max(power) > LINE * np.mean(power):
                return True
        return False

    def curves(self) -> list[Curve]:
        """Return what the model makes of each recording, where its pieces are."""
        found, begin = [], 0
        chain = self.chain
        for number, record in enumerate(self.layout.records):
            rows, valid = self.layout.rows[number], self.layout.valid[number].ravel()
            flat, order = rows.ravel()[valid], self.layout.plain.order
            shape = (len(record.times), chain.levels, chain.parts, chain.sites)
            seen, level = np.full(shape, np.nan), np.full(shape, np.nan)
            field = np.full((shape[0], order, *shape[2:]), np.nan)
            part = slice(begin, begin + rows.size)
            begin += rows.size
            level[flat] = self.followed.level[part][valid].reshape(-1, *shape[1:])
            seen[flat] = self.followed.left[part][valid].reshape(-1, *shape[1:]) + level[flat]
            # Where a zero wanders, the instrument reads the motion from there.
            level[flat] += np.nan_to_num(self.followed.left - self.left)[part][valid].reshape(-1, *shape[1:])
            level[..., self.layout.plain.border] = np.nan
            nodes, splines = self.followed.nodes[number], self.followed.splines[number]
            field[flat] = fields(self.layout, number, nodes, splines)[1][valid]
            found.append(Curve(record.times, seen, level, field))
        return found


def fit(
    model: Model,
    layout: Layout,
    near: Sequence[Float[ndarray, "pieces m state"]],
    *,
    structure: Structure | None,
    noise: Noise | None = None,
    steps: int = 20,
    hope: float = np.inf,
    splines: Sequence[ndarray | None] | None = None,
) -> Fitted | None:
    """Fit a model to pieces; None where it cannot be followed, overflows, or there is no hope for it.

    Args:
        model: with the numbers to start from.
        layout: the pieces.
        near: states to start from, of each recording.
        structure: of the noise; chosen by the readings if None.
        noise: to start from.
        steps: largest number of Gauss-Newton steps.
        splines: of the curves of the sites without an equation, to start from.
        hope: a cost; the fit is given up where the next step promises less than half of the way there.
    """
    path = follow(model, layout, near, splines=splines) if model.possible else None
    followed = None if path is None else linearised(path, layout)
    if followed is None:
        return None
    rows = replace(layout.laid_out(), walking=model.walking)
    free, curved = _taken(followed, layout, rows)
    share = left_free(1.0, curved / max(layout.readings(), 1))
    noise, cost = _likely(followed, rows, free, share, structure, noise)
    if np.any(curved):
        free, curved = _leverage(followed, layout, noise, rows, curved)
        noise, cost = _likely(followed, rows, free, share, structure, noise)
    damping, converged = DAMPING, False
    for step in range(steps):
        least = (cost - hope) / 2 if step >= BLIND else 0.0
        found = _stepped(layout, followed, noise, rows, damping, least / share)
        if found is None:
            converged = True
            break
        followed, damping, won = found
        if np.any(curved):
            free, curved = _leverage(followed, layout, noise, rows, curved)
        noise, cost = _likely(followed, rows, free, share, structure, noise)
        if won < ENOUGH:
            converged = True
            break
    if cost > hope:
        return None
    _, error, slope, robust = whitened(followed, noise, rows)
    solved = normal(layout, error, slope, followed.local, 0.0)
    dispersion = solved.dispersion()
    covariance = solved.covariance() * spread(error, robust, noise.tail) * dispersion
    if not np.all(np.isfinite(covariance)):
        return None
    path = replace(followed.path, model=followed.model.with_walks(noise.walk))
    return Fitted(layout, path, noise, cost, covariance, dispersion, converged, rows, curved)


def spread(error: ndarray, robust: ndarray, tail: float) -> float:
    """Return the variance of a robust fit's numbers over that of a weighted one (Huber, Ann. Stat. 1, 799 (1973)).

    It is <psi^2> <w> / <psi'>^2 with psi = w z and w = (nu + 1) / (nu + z^2): the weights follow what is left, so that
    their sum overstates what the readings tell, for Student's t by (nu + 3) / (nu + 1).

    Args:
        error: innovations times the roots of their weights, sqrt(w) z.
        robust: sqrt(w), 0 where nothing was read.
        tail: nu.
    """
    if not np.isfinite(tail):
        return 1.0
    read = robust > 0
    weight = robust[read] ** 2
    slope = weight * (2 * tail * weight / (tail + 1) - 1)
    return float(np.mean((error * robust)[read] ** 2) * np.mean(weight) / max(float(np.mean(slope)), 0.1) ** 2)


def gain(
    before: float, after: Float[ndarray, " *candidates"] | float, count: float, least: float
) -> Float[ndarray, " *candidates"]:
    """Return the nats that a fall of the sum of squares is worth, the size of the noise being free above its least.

    Args:
        before: the sum, in units of the noise.
        after: what it falls to.
        count: of readings.
        least: the smallest variance of the noise, in the same units.
    """

    def cost(total: ndarray | float) -> ndarray:
        variance = np.maximum(np.asarray(total) / count, least)
        return np.log(variance) + total / count / variance

    return np.asarray(count / 2 * (cost(before) - cost(np.maximum(after, MOST_TAKEN * before))))


def left_free(count: float, taken: Float[ndarray, " sensors"] | float) -> float:
    """Return how many of so many readings a fit leaves free that takes some of them, at least SPARE of all."""
    return max(count - float(np.sum(taken)), SPARE * count)


def _taken(followed: Followed, layout: Layout, rows: Rows) -> tuple[ndarray, Float[ndarray, " sensors"]]:
    """Return how many numbers a fit took from the readings of each sensor, and how many of them are of its curve."""
    sensors = int(np.max(rows.sensor)) + 1
    outer = np.isin(np.arange(sensors) % layout.chain.sites, layout.plain.border)
    inner = len(followed.model.numbers) + layout.pieces * followed.size
    curves = layout.pieces * (followed.local - followed.size)
    curved = np.where(outer, curves / max(int(np.sum(outer)), 1), 0.0)
    return np.where(outer, curved, inner / max(int(np.sum(~outer)), 1)), curved


def _leverage(
    followed: Followed, layout: Layout, noise: Noise, rows: Rows, curved: Float[ndarray, " sensors"]
) -> tuple[Float[ndarray, " sensors"], Float[ndarray, " sensors"]]:
    """Return what `_taken` does, by how far readings draw the fit to themselves: traces of the hat matrix.

    Where curves are fitted, the readings of their neighbours tell as much of them as their own do.
    """
    _, error, slope, _ = whitened(followed, noise, rows)
    solved, size = normal(layout, error, slope, followed.local, 0.0), followed.local
    scale = 1 / np.sqrt(np.maximum(np.diag(solved.matrix), 1e-200))
    inverse = np.linalg.pinv(solved.matrix * scale * scale[:, None], rcond=UNDETERMINED, hermitian=True)
    pulls = []
    for by, inner in zip(solved.slope, solved.inner, strict=True):
        unit, divided = scaled_inverse(np.swapaxes(by[:, :, :size], 1, 2) @ by[:, :, :size], 0.0)
        local = by[:, :, :size] / unit[:, None]
        rest = (by[:, :, size:] - by[:, :, :size] @ inner[:, :, :-1]) * scale
        pulls.append((np.sum((local @ divided) * local, axis=2) + np.sum((rest @ inverse) * rest, axis=2)).ravel())
    channels = np.broadcast_to(rows.sensor, (len(error), len(rows.sensor)))
    sensor = np.concatenate([one.ravel() for one in by_pieces(layout, channels)])
    free = np.bincount(sensor, np.concatenate(pulls), minlength=len(curved))
    return free, free * (np.sum(curved) / max(float(np.sum(free)), 1e-300))


def _likely(
    followed: Path, rows: Rows, free: ndarray, share: float, structure: Structure | None, start: Noise | None
) -> tuple[Noise, float]:
    """Return the noise that makes what is left most likely, and the cost; see `Fitted.cost` for the share."""
    noise = estimate(followed.left, followed.swing, rows, free=free, structure=structure, start=start)
    return noise, noise.price - share * noise.log_likelihood(followed.left, followed.swing, rows)


def _stepped(
    layout: Layout, followed: Followed, noise: Noise, rows: Rows, damping: float, least: float
) -> tuple[Followed, float, float] | None:
    """Return where a step leads, the damping of the next and the nats won; None where none promises enough."""
    _, error, slope, _ = whitened(followed, noise, rows)
    before, size = -noise.log_likelihood(followed.left, followed.swing, rows), followed.local
    total, count = float(np.sum(error**2)), int(np.sum(np.isfinite(followed.left)))
    lowest = float(np.min(rows.least / noise.size)) ** 2
    for _ in range(MOST_FAILURES):
        problem = normal(layout, error, slope, size, damping)
        change = problem.step(damping)
        if not np.all(np.isfinite(change)):
            return None
        promised = problem.promised(change)
        if promised < ENOUGH / 2 or gain(total, total - 2 * promised, count, lowest) < least:
            return None
        near, splines = [], []
        for number, (y, moves, inner) in enumerate(zip(followed.nodes, followed.moves, problem.inner, strict=True)):
            local = inner[:, :, -1] - inner[:, :, :-1] @ change
            splines.append(layout.bordered(number, followed.splines[number], local[:, y.shape[-1] :]))
            varied = np.concatenate([local, np.broadcast_to(change, (len(local), len(change)))], axis=1)
            near.append(y + (varied[:, None, None] @ moves)[:, :, 0])
        model = followed.model.moved(followed.model.numbers + change)
        trial = follow(model, layout, near, followed.transitions, splines) if model.possible else None
        if trial is not None:
            won = before + noise.log_likelihood(trial.left, trial.swing, rows)
            further = linearised(trial, layout) if won > -1e-6 else None
            if further is not None:
                return further, max(damping * LESS, 1e-9), won
        damping = max(damping, DAMPING) * MORE
    return None
