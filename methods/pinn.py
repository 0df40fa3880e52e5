"""The paper's physics-informed neural network: a curve through the samples that obeys the library's equation.

A fully connected tanh network takes the time t and gives u_n(t) at every site, for order 2 also v_n(t), for a complex
field real and imaginary parts. Its weights and the coefficients xi are trained together on the loss that
`methods.engine.networks.loss` writes out: the samples, du/dt = v, and the equation where the whole stencil was observed
(the paper's interior sites) or, where the ends of the chain are known, at every site. Adam comes first, then L-BFGS.

From the paper: the architecture, the outputs, both residuals, the mirrored data, Adam and L-BFGS as examples of
optimisers (its sections 2.2, 3 and 4.2). It says nothing about loss weights, learning rates, numbers of steps, numbers
of collocation points, initial weights or the scaling of time; the defaults of `PINN` are this project's.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from latticebench.methods.engine.bounds import Count, CountOrNone, Positive, Several
from latticebench.methods.engine.networks.arrays import Arrays, check_device, host, one_thread
from latticebench.methods.engine.networks.descent import adam, lbfgs, lockstep
from latticebench.methods.engine.networks.history import HistoryLog
from latticebench.methods.engine.networks.loss import JointLoss, LossSettings, NetworkLoss
from latticebench.methods.engine.networks.members import best_member, member_draws, spread
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.methods.method import Abilities, Fit, History
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array


@dataclass(frozen=True)
class PINN:
    """The paper's network, trained by Adam and then L-BFGS; see the module for its loss.

    Attributes:
        layers: number of hidden layers (the paper's 3).
        width: number of tanh units in each (the paper's 40).
        mirror: learn the samples of -u in the same network, too (the paper's data augmentation for even terms).
        collocation: number of evenly spaced times, ends included, at which the equation is asked for.
        data_weight: weight of the samples against the equation, both as shares of their own size.
        frequency: the first layer's weights and biases start uniform in +- this, in radians per half the time span.
        coefficient_scale: unit of a coefficient in the optimisers, in multiples of the one at which its term alone is
            as large as the rate. Terms of a lattice cancel each other to a tenth or less, so that coefficients are
            large in units of 1 and would lag behind the weights.
        adam_steps: number of Adam's steps.
        learning_rate: Adam's first learning rate; it falls to 0 along half a cosine.
        lbfgs_steps: maximum number of L-BFGS's evaluations.
        memory: number of steps that L-BFGS remembers.
        record: steps between two records of the coefficients.
        device: cpu, or a device of torch's such as cuda; cpu:0 is torch on the processor.
        members: number of networks with different first weights; the one with the least loss is the fit, and `found`
            has the standard deviation of each coefficient over them. On a device they take one step together and L-BFGS
            is `lockstep`; eight of them cost 0.74 of eight single ones on torch with one thread of a processor. On
            NumPy arrays one trains after the other, since a batch of eight cost 1.26 there.

    Raises:
        InputError: there is no such device.
    """

    name: ClassVar[str] = "pinn"
    layers: Count = 3
    width: Count = 40
    mirror: bool = False
    collocation: Several = 201
    data_weight: Positive = 100.0
    frequency: Positive = 3.0
    coefficient_scale: Positive = 10.0
    adam_steps: CountOrNone = 1000
    learning_rate: Positive = 3e-3
    lbfgs_steps: CountOrNone = 7000
    memory: Count = 20
    record: Count = 100
    device: str = "cpu"
    members: Count = 1

    def __post_init__(self) -> None:
        """Check the device."""
        check_device(self.device)

    @property
    def abilities(self) -> Abilities:
        """Everything but the truth."""
        return Abilities(missing=True, loads=() if self.device == "cpu" else ("torch",))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Train weights and coefficients together; several trajectories have a network each and share coefficients.

        Raises:
            InputError: torch does not have the device.
        """
        arrays = Arrays(self.device)
        sizes = estimate_sizes(data, library, order)
        lead = (self.members,) if arrays.batches else ()
        settings = LossSettings(self.layers, self.width, self.collocation, self.data_weight, lead)
        losses = [
            NetworkLoss(
                [samples, samples.mirrored()] if self.mirror else [samples],
                library, order, sizes, settings, arrays, 1 / len(data),
            )
            for samples in data
        ]  # fmt: skip
        joint = JointLoss(losses, self.coefficient_scale * sizes.coefficients())
        draws = member_draws(seed, self.members)
        since = time.perf_counter()
        with one_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            trained = [
                one
                for group in ([draws] if arrays.batches else [[draw] for draw in draws])
                for one in self._train(joint, group, since)
            ]
        best = trained[best_member(np.array([one.loss for one in trained]))]
        found = {"loss": best.loss, **spread(np.array([one.coefficients for one in trained]), library)}
        return Fit(self.name, library, order, best.coefficients, best.residual, history=best.history, found=found)

    def _train(self, joint: JointLoss, draws: Sequence[np.random.Generator], since: float) -> list[TrainedNetwork]:
        """Train one network, or the members of a batch together."""
        xp = joint.arrays.xp
        lead = (len(draws),) if joint.arrays.batches else ()
        log = HistoryLog(self.record, since)

        def note(step: int, loss: Array, point: Array) -> None:
            if log.due(step):
                log.note(step, host(loss), host(joint.coefficients(point)))

        def later(step: int, loss: Array, point: Array) -> None:
            note(self.adam_steps + step, loss, point)

        evaluate_at = joint.value_and_gradient
        point = adam(
            evaluate_at, joint.start(self.frequency, draws, lead), self.adam_steps, self.learning_rate, note, xp
        )
        if lead:
            point = lockstep(evaluate_at, point, self.lbfgs_steps, self.memory, later, xp)
        else:
            point = lbfgs(evaluate_at, point, self.lbfgs_steps, self.memory, later)
        loss, coefficients = host(evaluate_at(point)[0]), host(joint.coefficients(point))
        log.note(self.adam_steps + self.lbfgs_steps, loss, coefficients, always=True)
        missed, whole = (host(squares) for squares in joint.squares(point))
        residual = np.sqrt(np.where(whole > 0, missed / whole, missed))
        return [
            TrainedNetwork(float(loss[of]), coefficients[of], float(residual[of]), log.history(of[0] if of else None))
            for of in np.ndindex(*lead)
        ]


class TrainedNetwork(NamedTuple):
    """What the training of one network, or of one member, ended with."""

    loss: float
    coefficients: Float[ndarray, " terms"]
    residual: float
    history: History


METHODS = (PINN,)
