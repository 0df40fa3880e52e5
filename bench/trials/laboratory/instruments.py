"""Instruments of laboratories: when they read, how their noise is drawn, and how much the readings tell.

Every kind has a noise scale per sensor. `whitened` turns sensitivities of clean readings into units of the noise, in
which the information of the readings is the sum of squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

Kind = Literal[
    "white", "heavy-tailed", "coloured", "coarse", "proportional", "unequal", "spikes", "gaps", "drifting-zero",
    "jittered-gaps", "shaken", "slow", "held",
]  # fmt: skip
KINDS: tuple[Kind, ...] = (
    "white", "heavy-tailed", "coloured", "coarse", "proportional", "unequal", "spikes", "gaps",
)  # fmt: skip
HELD_OUT: tuple[Kind, ...] = ("drifting-zero", "jittered-gaps")
# All there are; those that are not among `KINDS` come only where they are asked for.
EVERY_KIND: tuple[Kind, ...] = (*KINDS, *HELD_OUT, "shaken", "slow", "held")
QUIETEST, LOUDEST = 0.002, 0.05
# Rounded times have so many values in an interval.
DIGITS = 200
# Of Student's t.
FREEDOM = 3.0


@dataclass(frozen=True, eq=False)
class Instrument:
    """An instrument.

    Attributes:
        kind: its name.
        level: noise of the sensors over the RMS of the readings about their means (the step of a coarse converter: over
            the same).
        each: noise of each sensor over `level` (N,).
        memory: correlation of the noise from one reading to the next, or of its slow part.
        slow: share of the noise's variance that is slow where the rest is white; 0 where all of it is alike.
        common: share of the noise's variance that all sensors have in common, as where a camera shakes.
        sway: correlation of that part from one reading to the next.
        turn: how far that part differs between the ends of the chain, over its size in the middle: the camera turns.
        growth: noise at a reading of RMS size over noise at 0, squared, less 1; of proportional noise.
        rate, height: share of readings that are spikes, and the largest size of one in units of the noise.
        drift: how far one sensor's zero goes, in units of the noise; `drifter` is the sensor, and `trend` says
            whether it goes straight or as a random walk.
        uneven: by what share of the interval times differ from even ones.
        gone: share of the readings that are missing.
        cells: whether what is missing is single cells rather than rows.
        held: for how many slow periods of the chain the recording shows it held at its start before that.
        digits: whether times are recorded rounded, to the interval over `DIGITS`.
    """

    kind: Kind
    level: float
    each: Float[ndarray, " sites"]
    memory: float = 0.0
    slow: float = 0.0
    common: float = 0.0
    sway: float = 0.0
    turn: float = 0.0
    growth: float = 0.0
    rate: float = 0.0
    height: float = 0.0
    drift: float = 0.0
    drifter: int = 0
    trend: bool = False
    uneven: float = 0.0
    gone: float = 0.0
    cells: bool = False
    held: float = 0.0
    digits: bool = False

    def scale(self, clean: Float[ndarray, "time sites"], rms: float) -> Float[ndarray, "time sites"]:
        """Return the scale of the noise of each reading (of Student's t: not its standard deviation)."""
        noise = self.level * rms * self.each
        if self.kind == "coarse":
            noise = noise / np.sqrt(12)
        relative = (clean - clean.mean(axis=0)) / rms
        return np.asarray(noise * np.sqrt((1 + self.growth * relative**2) / (1 + self.growth)))

    def read(self, clean: ndarray, times: ndarray, rms: float, draw: np.random.Generator) -> ndarray:
        """Return readings with noise."""
        scale = self.scale(clean, rms)
        if self.kind == "coarse":
            # The step is sqrt(12) times its standard deviation; a little noise is there besides.
            step = self.level * rms * self.each
            return np.asarray(step * np.round((clean + 0.1 * step * draw.normal(size=clean.shape)) / step))
        if self.kind == "heavy-tailed":
            return np.asarray(clean + scale * draw.standard_t(FREEDOM, size=clean.shape))
        noise = _correlated(draw.normal(size=clean.shape), self.memory)
        if self.slow:
            noise = np.sqrt(self.slow) * noise + np.sqrt(1 - self.slow) * draw.normal(size=clean.shape)
        if self.common:
            shake = _correlated(draw.normal(size=(len(clean), 1)), self.sway)
            noise = np.sqrt(1 - self.common) * noise + np.sqrt(self.common) * shake * self.lever
        if self.rate:
            hit = draw.uniform(size=clean.shape) < self.rate
            heights = draw.choice([-1.0, 1.0], size=clean.shape) * draw.uniform(10.0, self.height, size=clean.shape)
            noise = np.where(hit, heights, noise)
        if self.drift:
            noise[:, self.drifter] += self.drift * self._course(times, draw)
        return np.asarray(clean + scale * noise)

    @property
    def lever(self) -> Float[ndarray, " sites"]:
        """What is common at each sensor over its size in the middle of the chain."""
        return 1 + self.turn * np.linspace(-0.5, 0.5, len(self.each)) if len(self.each) > 1 else np.ones(1)

    def _course(self, times: ndarray, draw: np.random.Generator) -> ndarray:
        """Return how a zero goes: straight on, or as a random walk of the same size."""
        along = (times - times[0]) / (times[-1] - times[0])
        if self.trend:
            return np.asarray(along)
        return np.cumsum(draw.normal(size=len(times)) * np.sqrt(np.diff(along, prepend=0.0)))

    def whitened(self, columns: Float[ndarray, "time sites columns"], clean: ndarray, rms: float) -> ndarray:
        """Return the columns in units of the noise (rows, columns): their inner products are Fisher's information.

        The information of Student's t is (nu + 1) / (nu + 3) over the scale squared; a reading that is a spike tells
        nothing. What the noise's own size tells about the reading is left out, and so is a zero that drifts.
        """
        if self.common or self.slow:
            return self._filtered(columns / self.scale(clean, rms)[:, :, None])
        scale = self.scale(clean, rms)[:, :, None]
        if self.kind == "coarse":
            # The rounding and the noise of a tenth of a step.
            scale = scale * np.sqrt(1 + 12 * 0.1**2)
        if self.kind == "heavy-tailed":
            scale = scale * np.sqrt((FREEDOM + 3) / (FREEDOM + 1))
        scale = scale / np.sqrt(1 - self.rate)
        weighed = columns / scale
        if self.memory:
            weighed[1:] = (weighed[1:] - self.memory * weighed[:-1]) / np.sqrt(1 - self.memory**2)
        return np.asarray(weighed.reshape(-1, columns.shape[2]))

    def _filtered(self, columns: Float[ndarray, "time sites columns"]) -> ndarray:
        """Return columns in independent units of noise that is white but for a slow part, by a Kalman filter of that.

        The slow part is one number for all sensors where it is common, else one for each. The readings less what is
        foreseen of it have the covariance V I + W P W^T, where V is the variance of the white noise, P the covariance
        of the slow part as it is foreseen, and W says how much of it each sensor has.
        """
        sites, share = len(self.each), self.common or self.slow
        w = np.sqrt(share) * (self.lever[:, None] if self.common else np.eye(sites))
        sway = self.sway if self.common else self.memory
        rest = np.eye(w.shape[1])
        foreseen, covariance = np.zeros((w.shape[1], columns.shape[2])), rest
        found = np.empty_like(columns)
        for row, part in enumerate(columns):
            new = part - w @ foreseen
            root = np.linalg.cholesky((1 - share) * np.eye(sites) + w @ covariance @ w.T)
            found[row] = np.linalg.solve(root, new)
            pull = np.linalg.solve(root.T, np.linalg.solve(root, w @ covariance)).T
            foreseen = sway * (foreseen + pull @ new)
            covariance = sway**2 * (covariance - pull @ w @ covariance) + (1 - sway**2) * rest
        return np.asarray(found.reshape(-1, columns.shape[2]))

    def times(self, span: float, readings: int, draw: np.random.Generator) -> tuple[ndarray, ndarray]:
        """Return the times at which readings are taken, and the times that are recorded."""
        even = np.linspace(0.0, span, readings)
        step = even[1]
        if not self.uneven:
            return even, even
        taken = np.sort(even + step * self.uneven * draw.uniform(-1, 1, size=readings))
        taken -= taken[0]
        # Two readings at the same time would be no recording.
        taken = np.maximum.accumulate(taken + 1e-6 * step * np.arange(readings))
        if not self.digits:
            return taken, taken
        told = np.round(taken / (step / DIGITS)) * (step / DIGITS)
        apart = np.concatenate([[True], np.diff(told) > 0.5 * step / DIGITS])
        return taken[apart], told[apart]

    def before(self, taken: ndarray, clean: ndarray, period: float) -> tuple[ndarray, ndarray]:
        """Return times and clean readings with those before them in which a hand holds the chain at its start."""
        step = float(taken[1] - taken[0])
        rows = int(self.held * period / step)
        early = taken[0] + step * np.arange(-rows, 0)
        return np.concatenate([early, taken]), np.concatenate([np.repeat(clean[:1], rows, axis=0), clean])

    def missing(self, readings: int, sites: int, draw: np.random.Generator) -> Bool[ndarray, "time sites"]:
        """Return which readings are missing: single cells, or whole rows in a few stretches."""
        gone = np.zeros((readings, sites), dtype=bool)
        if self.cells:
            gone = draw.uniform(size=gone.shape) < self.gone
        elif self.gone:
            stretches = int(draw.integers(1, 5))
            length = max(int(self.gone * readings / stretches), 1)
            for first in draw.integers(readings // 20, readings - length - readings // 20, size=stretches):
                gone[first : first + length] = True
        gone[[0, -1]] = False
        return gone


def _correlated(white: ndarray, memory: float) -> ndarray:
    """Return an AR(1) process of variance 1 along the first axis."""
    from scipy.signal import lfilter

    if not memory:
        return white
    driven = np.sqrt(1 - memory**2) * white
    driven[0] = white[0]
    return np.asarray(lfilter([1.0], [1.0, -memory], driven, axis=0))


def draw_instrument(draw: np.random.Generator, sites: int, kind: Kind) -> Instrument:
    """Return an instrument of a kind.

    Args:
        draw: for its noise and all that belongs to the kind.
        sites: number of sensors.
        kind: which.
    """
    level = float(np.exp(draw.uniform(np.log(QUIETEST), np.log(LOUDEST))))
    plain = Instrument(kind, level, np.ones(sites))
    match kind:
        case "coloured":
            return replace(plain, memory=float(draw.uniform(0.5, 0.85)))
        case "coarse":
            return replace(plain, level=float(np.exp(draw.uniform(np.log(0.01), np.log(0.08)))))
        case "proportional":
            return replace(plain, growth=float(draw.uniform(3.0, 15.0)))
        case "unequal":
            ratio = float(np.exp(draw.uniform(np.log(2), np.log(10))))
            each = ratio ** draw.permutation(np.linspace(-0.5, 0.5, sites) if sites > 1 else np.zeros(1))
            return replace(plain, each=each)
        case "spikes":
            return replace(plain, rate=float(draw.uniform(0.005, 0.02)), height=float(draw.uniform(15, 50)))
        case "gaps":
            return _with_gaps(plain, draw, int(draw.integers(3)))
        case "drifting-zero":
            return replace(
                plain, drift=float(draw.choice([-1.0, 1.0]) * draw.uniform(3.0, 8.0)),
                drifter=int(draw.integers(sites)), trend=bool(draw.uniform() < 0.5),
            )  # fmt: skip
        case "shaken":
            return replace(
                plain, common=float(draw.uniform(0.3, 0.95)), turn=float(draw.choice([0.0, 1.0]) * draw.uniform(-1, 1)),
                sway=float(draw.choice([0.0, 1.0, 1.0]) * draw.uniform(0.3, 0.95)),
            )  # fmt: skip
        case "slow":
            return replace(plain, slow=float(draw.uniform(0.3, 0.8)), memory=float(draw.uniform(0.8, 0.98)))
        case "held":
            return replace(plain, held=float(draw.uniform(0.4, 4.0)))
        case "jittered-gaps":
            return replace(
                _with_gaps(plain, draw, 1), uneven=float(draw.uniform(0.1, 0.45)), digits=bool(draw.uniform() < 0.5)
            )
        case _:
            return plain


def _with_gaps(plain: Instrument, draw: np.random.Generator, way: int) -> Instrument:
    """Return an instrument with uneven times (0), missing stretches (1) or missing cells (2)."""
    if way == 0:
        return replace(plain, uneven=float(draw.uniform(0.2, 0.9)))
    return replace(plain, gone=float(draw.uniform(0.05, 0.25)), cells=way == 2)
