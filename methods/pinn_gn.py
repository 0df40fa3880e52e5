"""A physics-informed network trained as a likelihood, by Gauss-Newton steps in all its weights.

One hidden layer of sines of time (or tanh units), shared by all sites; its output layer is the motion u_n(t), with
exact time derivatives. Hidden layer, output layer and coefficients are trained together
(`methods.engine.networks.trained_curve` has the objective), with exact derivatives and Levenberg-Marquardt damping of
the hidden layer. Differences from `pinn`, whose loss it shares in kind:

- Data and physics: the samples count by their noise, which is estimated from the samples, and the weight of the
  equation grows until the network follows it as a motion does (`methods.engine.networks.stiffening`). Then the fit is
  the maximum of the likelihood of the equation's solutions.
- Size: the number of frequencies follows from the samples' root-mean-square frequency. It is raised until there is a
  range of weights in which the coefficients stand still.
- Start: the smoothed samples, and the coefficients that best carry them on. Nothing is drawn but the frequencies'
  small displacements.
- Records of many periods are cut into pieces, with a network each and common coefficients.

Standard errors are those of the Gauss-Newton matrix with the estimated noise. With `members`, as many more networks are
trained on samples drawn from the fit with its noise (the parametric bootstrap: Efron & Tibshirani, An Introduction to
the Bootstrap, chapter 6 (1993)).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from latticebench.methods.engine.bounds import Count, CountOrNone, Positive
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.engine.networks.arrays import Arrays, check_device, one_thread
from latticebench.methods.engine.networks.hidden_layer import REDUNDANT, Activation, draw_layer
from latticebench.methods.engine.networks.members import spread
from latticebench.methods.engine.networks.side_by_side import Device
from latticebench.methods.engine.networks.stiffening import Stage, Training, first_stage, minimise, retrain, stiffen
from latticebench.methods.engine.networks.trained_curve import TrainedCurve, Weights, place_curve
from latticebench.methods.engine.record import Record, prepare, without_halves
from latticebench.methods.engine.starts import guess, smooth
from latticebench.methods.method import Abilities, Fit, History, Skipped, Smooth
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Frequencies beside those that the span asks for, and those of a network that is as large as is wise.
FURTHER = 4
MOST = 160
# A record that asks for more frequencies at the start is cut into pieces.
MOST_AT_START = 80
# A larger network has this many times the frequencies; it is another fit where its score is lower by this much.
GROWTH = 1.5
LOWER = 0.1
# Size of the output weights that decay does not hold down, in RMS of the field.
LARGE = 10.0
# Collocation times per unit.
DENSITY = 1.2


class Trained(NamedTuple):
    """What networks of one size ended with: the networks, the stage that was taken, and the way there."""

    curves: list[TrainedCurve]
    stage: Stage
    path: list[tuple[float, float, ndarray]]


@dataclass(frozen=True)
class PINNGaussNewton:
    """A network trained by Gauss-Newton steps in all its weights; see the module.

    Attributes:
        activation: of the hidden units, sine or tanh.
        width: number of hidden units; 0 for as many as the samples ask for.
        train: whether the hidden layer is trained; otherwise it stays as it was drawn.
        bandwidth: highest frequency at the start, in multiples of the samples' root-mean-square angular frequency.
        stages: largest number of weights of the equation, each ten times the last.
        steps: largest number of Gauss-Newton steps per weight.
        tolerance: a network is large enough when a tenfold weight moves no coefficient by more than this share of its
            standard error; a stage ends when a step moves none by more.
        precision: it is also large enough when the standard errors are below this share of the coefficients.
        members: number of networks trained on samples drawn from the fit; 0 for none. `found` has the standard
            deviation of each coefficient over them, and the half-width of the interval of 95 % that follows from it.
            On a device they take their steps together.
        device: cpu, or a device of torch's such as cuda; cpu:0 is torch on the processor.

    Raises:
        InputError: there is no such device.
    """

    name: ClassVar[str] = "pinn-gn"
    activation: Activation = "sine"
    width: CountOrNone = 0
    train: bool = True
    bandwidth: Positive = 4.0
    stages: Count = 24
    steps: Count = 6
    tolerance: Positive = 0.05
    precision: Positive = 1e-7
    members: CountOrNone = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Check what no bound says."""
        check_device(self.device)
        if self.members == 1:
            raise InputError("setting members = 1: one has no spread, take 0, or 2 and more")

    @property
    def abilities(self) -> Abilities:
        """The method takes complex fields, inputs, uneven times and missing values."""
        torch = () if self.device == "cpu" else ("torch",)
        return Abilities(missing=True, loads=("scipy.linalg", "scipy.interpolate", "sympy", *torch))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Train networks of growing size until the coefficients stand still.

        Raises:
            InputError: the equation cannot be set up on the samples, they are too few to start from, or torch does not
                have the device.
            Skipped: velocities were observed in some trajectories only.
        """
        if order == 2 and len({samples.v is None for samples in data}) > 1:
            raise Skipped("velocities were observed in some trajectories only")
        began = time.perf_counter()
        with one_thread():
            data = [without_halves(samples) for samples in data]
            frequency = _frequency(data, order)
            cuts = [self._pieces(samples, frequency) for samples in data]
            pieces = [piece for cut in cuts for piece in cut]
            device = None if self.device == "cpu" else Device(Arrays(self.device), pieces, library)
            best, path = self._grown(pieces, library, order, frequency, seed, device)
            drawn = self._members(best, seed, device)
        stage = best.stage
        found: dict[str, float | str] = {
            "weight": stage.weight, "units": float(max(len(one.a) for one in stage.weights)),
            "noise_u": float(stage.sigma[0]),
        }  # fmt: skip
        if len(stage.sigma) > 1:
            found["noise_v"] = float(stage.sigma[1])
        if self.members:
            found |= spread(drawn, library) | _intervals(drawn, library)
        curves = [curve.smooth(one) for curve, one in zip(best.curves, stage.weights, strict=True)]
        seconds, scores, coefficients = map(np.array, zip(*path, strict=True))
        return Fit(
            self.name, library, order, stage.coefficients, _left(curves, stage),
            stderr=np.sqrt(np.maximum(np.diag(stage.covariance), 0)),
            status="ok" if math.isfinite(stage.moved) else "the samples are too few to tell noise from motion",
            history=History(np.arange(1.0, len(path) + 1), seconds - began, scores, coefficients),
            found=found, smooth=_joined(curves, [len(cut) for cut in cuts]),
        )  # fmt: skip

    def _pieces(self, samples: Samples, frequency: float) -> list[Samples]:
        """Cut a record of many periods into pieces that one network each can follow."""
        if self.width:
            return [samples]
        count = min(math.ceil(self._asked(samples, frequency) / MOST_AT_START), max(1, len(samples.t) // 8))
        return [
            samples.of_rows(slice(some[0], some[-1] + 1))
            for some in np.array_split(np.arange(len(samples.t)), count)
        ]  # fmt: skip

    def _asked(self, samples: Samples, frequency: float) -> int:
        """Return how many frequencies the span of a record asks for at the start."""
        half = float(samples.t[-1] - samples.t[0]) / 2
        return math.ceil(self.bandwidth * frequency * half / (REDUNDANT * math.pi / 2)) + FURTHER

    def _grown(
        self, data: Sequence[Samples], library: Library, order: int, frequency: float, seed: int, device: Device | None
    ) -> tuple[Trained, list[tuple[float, float, ndarray]]]:
        """Train networks of one size after another; return the best ones, and the way of all."""
        records = [prepare(samples, library.terms, order) for samples in data]
        coefficients = guess(data, records).coefficients
        counts = [self.width // 2 or self._asked(samples, frequency) for samples in data]
        draw = np.random.default_rng(seed)
        best: Trained | None = None
        path: list[tuple[float, float, ndarray]] = []
        while True:
            made = [
                self._network(samples, record, max(count, 1), frequency, draw)
                for samples, record, count in zip(data, records, counts, strict=True)
            ]
            curves = [curve for curve, _ in made]
            start = first_stage(curves, [weights for _, weights in made], coefficients)
            stage, way = stiffen(curves, start, self._training, draw, device.minimise if device else minimise)
            path += way
            better = best is None or (stage is not None and _better(stage, best.stage))
            if better:
                best = Trained(curves, stage or start, way)
            assert best is not None
            error = np.linalg.norm(np.sqrt(np.maximum(np.diag(best.stage.covariance), 0)))
            exact = error < self.precision * np.linalg.norm(best.stage.coefficients)
            counts = [math.ceil(GROWTH * count) for count in counts]
            if self.width or stage is None or best.stage.moved < self.tolerance or exact or max(counts) > MOST:
                break
            if not better and stage.score > best.stage.score + LOWER:
                break
            coefficients = best.stage.coefficients
        return best, path or [(time.perf_counter(), best.stage.score, best.stage.coefficients)]

    @property
    def _training(self) -> Training:
        return Training(self.stages, self.steps, self.tolerance, self.train)

    def _network(
        self, samples: Samples, record: Record, count: int, frequency: float, draw: np.random.Generator
    ) -> tuple[TrainedCurve, Weights]:
        """Draw a network and let it follow the smoothed samples."""
        dynamics = record.stretches.dynamics
        height = float(np.sqrt(np.sum(record.value[:, 0] ** 2) / max(np.sum(record.seen[:, 0]), 1)))
        highest = self.bandwidth * frequency * (record.times[-1] - record.times[0]) / 2
        theta = draw_layer(self.activation, count, float(highest), draw)
        points = math.ceil(DENSITY * (2 * count + 1))
        curve = place_curve(record, self.activation, points, LARGE * (height if height > 0 else 1.0))
        layer = curve.layer(theta)
        fields = smooth(samples, dynamics.order)
        rows, target = [], []
        for level, field in enumerate(fields):
            if field is not None:
                size = frequency**level
                rows.append(layer.levels[level, points:] / size)
                parts = np.swapaxes(split_parts(np.nan_to_num(field), samples.is_complex), 1, 2) / size
                target.append(parts.reshape(len(parts), -1)[:, np.argsort(curve.place.ravel())])
        units = layer.levels.shape[-1]
        # A little decay chooses among weights that the smoothed samples do not tell apart.
        matrix = np.concatenate([*rows, 1e-4 * np.eye(units)])
        values = np.concatenate([*target, np.zeros((units, target[0].shape[1]))])
        return curve, Weights(theta, np.linalg.lstsq(matrix, values, rcond=None)[0])

    def _members(self, best: Trained, seed: int, device: Device | None) -> Float[ndarray, "member terms"]:
        """Train networks on samples drawn from the fit with its noise; return their coefficients."""
        draw = np.random.default_rng([seed, 1])
        fitted = [
            curve.fitted(curve.layer(weights.theta), weights.a)
            for curve, weights in zip(best.curves, best.stage.weights, strict=True)
        ]
        sigma = best.stage.sigma[:, None, None]
        # Member by member, and of each member trajectory by trajectory.
        noisy = [[one + sigma * draw.normal(size=one.shape) for one in fitted] for _ in range(self.members)]
        seen = [
            [np.where(curve.seen, one, 0.0) for curve, one in zip(best.curves, member, strict=True)] for member in noisy
        ]
        if device and seen:
            together = [np.stack(values) for values in zip(*seen, strict=True)]
            return device.retrain(best.curves, best.stage, self._training, together)
        return np.array([
            retrain(
                [replace(curve, value=one) for curve, one in zip(best.curves, member, strict=True)],
                best.stage, self._training,
            )
            for member in seen
        ])  # fmt: skip


def _frequency(data: Sequence[Samples], order: int) -> float:
    """Return the root-mean-square angular frequency of the smoothed samples, 1 over the span where nothing moves."""
    rates, motions, spans = [0.0], [0.0], []
    for samples in data:
        u, v = smooth(samples, order)
        motion = u - np.mean(u, axis=0) if v is None else v
        rate = np.gradient(motion, samples.t, axis=0)
        rates.append(float(np.nansum(np.abs(rate) ** 2)))
        motions.append(float(np.nansum(np.abs(motion) ** 2)))
        spans.append(float(samples.t[-1] - samples.t[0]))
    return max(math.sqrt(sum(rates) / sum(motions)) if sum(motions) > 0 else 0.0, 1 / max(spans))


def _better(stage: Stage, best: Stage) -> bool:
    """Return whether larger networks found another fit, or the same with coefficients that stand more still."""
    if not (math.isfinite(stage.moved) and math.isfinite(best.moved)):
        return stage.moved < best.moved
    return stage.score < best.score - LOWER or (stage.score < best.score + LOWER and stage.moved < best.moved)


def _intervals(drawn: ndarray, library: Library) -> dict[str, float]:
    """Return the half-width of the interval of 95 % of each coefficient, by Student's t."""
    from scipy.stats import t

    widths = t.ppf(0.975, len(drawn) - 1) * np.std(drawn, axis=0, ddof=1)
    return {f"interval of {text}": float(width) for text, width in zip(library.texts, widths, strict=True)}


def _left(curves: Sequence[Smooth], stage: Stage) -> float:
    """Return the RMS of the residual over that of the rate."""
    whole = sum(float(np.sum(one.levels[-1] ** 2 * one.share[:, None, None])) for one in curves)
    return math.sqrt(stage.law / whole) if whole > 0 else math.sqrt(stage.law)


def _joined(curves: Sequence[Smooth], counts: Sequence[int]) -> tuple[Smooth, ...]:
    """Join the curves of each trajectory's pieces."""
    joined, rest = [], list(curves)
    for count in counts:
        some, rest = rest[:count], rest[count:]
        joined.append(
            Smooth(
                np.concatenate([one.times for one in some]),
                np.concatenate([one.share for one in some]) / count,
                np.concatenate([one.levels for one in some], axis=1),
            )
        )
    return tuple(joined)


METHODS = (PINNGaussNewton,)
