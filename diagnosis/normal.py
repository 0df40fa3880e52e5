"""The linearised problem of a fit over pieces: normal equations of the model's numbers, and what they say of these."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.horizon import Layout
from latticebench.methods.engine.scaled import Scaled

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Directions of the numbers that the readings do not determine, as a share of the best determined one.
UNDETERMINED = 1e-9
# Below these shares, squares have lost digits that a covariance needs: of what a number does where the initial states
# do the most of it, as in chaotic motion over a long piece, and of what numbers do that are alike.
TAKEN, BLURRED = 1e-3, 1e-6
# The same of the derivatives themselves, beside what the initial states do; and what arithmetic leaves of a state that
# does nothing.
LOST, ROUNDING = 1e-6, 1e-13
# From so many pieces on a stretch is one of them or several: each has lost what its own initial state can do.
FEW_PIECES = 8
# How many standard deviations of chance are taken off the spread of a model's numbers between stretches.
CHANCE = 3.0


@dataclass(frozen=True, eq=False)
class Normal:
    """The linearised problem, whitened, with the initial states eliminated.

    Attributes:
        slope: derivatives by initial state and numbers, of each recording (pieces, rows * channels, S + G).
        error: what is left (pieces, rows * channels).
        inner: what each initial state follows: its derivatives by the numbers, last its own step (pieces, S, G + 1).
        matrix, target: of the numbers' normal equations.
    """

    slope: tuple[Float[ndarray, "pieces readings varied"], ...]
    error: tuple[Float[ndarray, "pieces readings"], ...]
    inner: tuple[Float[ndarray, "pieces state numbers_1"], ...]
    matrix: Float[ndarray, "numbers numbers"]
    target: Float[ndarray, " numbers"]

    @functools.cached_property
    def _scaled(self) -> tuple[ndarray, ndarray, ndarray]:
        scale = np.sqrt(np.maximum(np.diag(self.matrix), 1e-200))
        matrix = self.matrix / scale / scale[:, None]
        return scale, *np.linalg.eigh((matrix + matrix.T) / 2)

    def step(self, damping: float) -> Float[ndarray, " numbers"]:
        """Return the change of the numbers; none in directions that the readings do not determine."""
        scale, values, vectors = self._scaled
        held = values > UNDETERMINED
        inverse = np.where(held, 1 / (np.where(held, values, 1.0) + damping), 0.0)
        return np.asarray(vectors @ (inverse * (vectors.T @ (self.target / scale))) / scale)

    def covariance(self) -> Float[ndarray, "numbers numbers"]:
        """Return the covariance of the numbers; vast where the readings do not determine them."""
        scale, values, vectors = self._scaled
        size = self.inner[0].shape[1]
        before = sum(np.einsum("prg,prg->g", one[:, :, size:], one[:, :, size:]) for one in self.slope)
        if np.any(np.diag(self.matrix) < TAKEN * before) or np.min(values, initial=1.0) < BLURRED:
            return Scaled.of(self._beside_states()).covariance(LOST)
        return np.asarray((vectors / values) @ vectors.T / scale / scale[:, None])

    def _beside_states(self) -> Float[ndarray, "readings numbers"]:
        """Return the derivatives by the numbers, less what a change of the initial states does as well."""
        rest, size = [], self.inner[0].shape[1]
        for slope in self.slope:
            local = slope[:, :, :size] / np.maximum(np.linalg.norm(slope[:, :, :size], axis=1), 1e-100)[:, None]
            basis, triangle = np.linalg.qr(local)
            own = np.abs(np.diagonal(triangle, axis1=1, axis2=2)) > ROUNDING
            basis, by_number = basis * own[:, None], slope[:, :, size:]
            rest.append((by_number - basis @ (np.swapaxes(basis, 1, 2) @ by_number)).reshape(-1, slope.shape[2] - size))
        return np.concatenate(rest)

    def dispersion(self) -> float:
        """Return how many times as much as noise lets them the numbers vary between stretches, at least 1.

        The slope of the likelihood by the numbers vanishes for a recording as a whole. Of each of `rules.STRETCHES`
        stretches it is what noise makes it, if the model is right: the sum of s H^-1 s, where H is the information of
        all, is then a chi-squared variable. What is left of a model that is not quite right is smooth, and holds fewer
        independent numbers than there are readings: likelihood ratios are too large by this factor (the dispersion of
        a quasi-likelihood, Wedderburn, Biometrika 61, 439 (1974), from the score's variance over blocks, White,
        Econometrica 50, 1 (1982)). What chance alone makes is taken off.
        """
        scale, values, vectors = self._scaled
        held = values > UNDETERMINED
        if not np.any(held):
            return 1.0
        root = vectors[:, held] / np.sqrt(values[held]) / scale[:, None]
        size = self.inner[0].shape[1]
        own, left, ends = [], [], [0]
        pieces = sum(len(one) for one in self.error)
        for error, slope, inner in zip(self.error, self.slope, self.inner, strict=True):
            local = slope[:, :, :size]
            own.append(((slope[:, :, size:] - local @ inner[:, :, :-1]) @ root).reshape(-1, root.shape[1]))
            left.append((error - (local @ inner[:, :, -1:])[..., 0]).ravel())
            each = error.shape[1] if pieces >= FEW_PIECES else 1
            ends += (ends[-1] + each * np.arange(1, error.size // each + 1)).tolist()
        columns, rest = np.concatenate(own), np.concatenate(left)
        total, freedom = 0.0, float(root.shape[1])
        whole = columns.T @ rest
        bounds = np.array(ends)[np.linspace(0, len(ends) - 1, min(rules.STRETCHES, len(ends) - 1) + 1).astype(int)]
        for begin, end in itertools.pairwise(bounds):
            part = columns[begin:end]
            gram = part.T @ part
            total += float(np.sum((part.T @ rest[begin:end] - gram @ whole) ** 2))
            freedom -= float(np.sum(gram**2))
        likely = freedom + CHANCE * np.sqrt(2 * max(freedom, 0.0))
        return max(1.0, float(total / likely)) if np.isfinite(total) and likely > 0 else 1.0

    def promised(self, change: Float[ndarray, " numbers"]) -> float:
        """Return how many nats a step wins as far as the problem is linear."""
        total = float(self.target @ change)
        for error, slope, inner in zip(self.error, self.slope, self.inner, strict=True):
            right = np.einsum("prs,pr->ps", slope[:, :, : inner.shape[1]], error)
            total += float(np.sum(right * inner[:, :, -1]))
        return total / 2


def by_pieces(layout: Layout, flat: Float[ndarray, "rows channels *more"]) -> list[ndarray]:
    """Return rows of all recordings as pieces of each (pieces, m * channels, ...)."""
    found, begin = [], 0
    for rows in layout.rows:
        part = flat[begin : begin + rows.size]
        found.append(part.reshape(rows.shape[0], rows.shape[1] * flat.shape[1], *flat.shape[2:]))
        begin += rows.size
    return found


def normal(layout: Layout, error: ndarray, slope: ndarray, size: int, damping: float) -> Normal:
    """Eliminate the initial states, of `size` numbers each, from the linearised problem."""
    errors, slopes = by_pieces(layout, error), by_pieces(layout, slope)
    count = slope.shape[-1] - size
    matrix, target, inner = np.zeros((count, count)), np.zeros(count), []
    for left, by in zip(errors, slopes, strict=True):
        gram = np.swapaxes(by, 1, 2) @ by
        right = (np.swapaxes(by, 1, 2) @ left[..., None])[..., 0]
        unit, divided = scaled_inverse(gram[:, :size, :size], damping)
        both = np.concatenate([gram[:, :size, size:], right[:, :size, None]], axis=2)
        x = (divided @ (both / unit[:, :, None])) / unit[:, :, None]
        across = np.swapaxes(gram[:, :size, size:], 1, 2)
        matrix += np.sum(gram[:, size:, size:] - across @ x[:, :, :-1], axis=0)
        target += np.sum(right[:, size:] - (across @ x[:, :, -1:])[..., 0], axis=0)
        inner.append(x)
    return Normal(tuple(slopes), tuple(errors), tuple(inner), matrix, target)


def scaled_inverse(gram: Float[ndarray, "pieces state state"], damping: float) -> tuple[ndarray, ndarray]:
    """Return scales, and the inverses of matrices that are divided by them on both sides and damped."""
    # What no reading depends on has a scale, too, whose square is a number.
    unit = np.sqrt(np.maximum(np.einsum("pss->ps", gram), 1e-200))
    scaled = gram / unit[:, :, None] / unit[:, None, :]
    scaled[:, np.arange(gram.shape[1]), np.arange(gram.shape[1])] += damping + 1e-11
    return unit, np.linalg.inv(scaled)
