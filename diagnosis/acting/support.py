"""A support that sways with all sites that hang on it, and is not read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.hanging import APART, FINE, UNTOLD, Hanging, frequencies
from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed
from latticebench.diagnosis.acting.scene import Chain, Course, Scene
from latticebench.methods.engine.dynamics import Factor
from latticebench.methods.engine.resonator import Resonator, Support, shaken
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Frequencies are tried from this share of the main one up to so many times the highest: a stiff support yields without
# swinging.
LOWEST, HIGHEST = 0.2, 4.0
# A site's mass beside that of a support which the sites do not move may seem to be negative by this.
HEAVY = 0.05


@dataclass(frozen=True, eq=False, kw_only=True)
class SwayingSupport(Hanging, acts="support"):
    """A bar or a board that sways on a spring and a dashpot, and carries all sites: the case of Huygens' clocks.

    See `methods.engine.resonator` for the equations; the strength is the mass of a site in units of the support's.

    The frequency is that of the support without what hangs on it.
    """

    shape: ClassVar[tuple[str, ...]] = ("omega", "gamma")
    separated_by: ClassVar[str] = "the same motion on a support that is held fast, or one that is read, too"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return frequencies about those of the motion, where several sites all have an equation."""
        chain = scene.chain
        if not scene.terms(effect) or not scene.main or not len(chain.moving) == chain.sites > 1:
            return
        for omega in frequencies(LOWEST * scene.main, HIGHEST * scene.top):
            yield cls(
                effect=effect, omega=float(omega), gamma=float((APART - 1) * omega), past=scene.past, step=scene.step,
                strength=(0.0,),
            )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the number is."""
        return ("site's mass beside the support's",)

    @property
    def possible(self) -> bool:
        """Whether it swings and loses, and the sites do not move it the wrong way."""
        return self.strength[0] > -HEAVY and -UNTOLD * self.omega < self.gamma < self.omega

    def resonator(self, chain: Chain) -> Resonator:
        """Return what swings with the sites."""
        return Support(tuple(range(len(chain.moving))), *map(float, self.numbers))

    def unread(self, past: Course, t: Float[ndarray, "*rows"]) -> Float[ndarray, "*rows 2"]:
        """Return about where the support would be, and its velocity, if all had no momentum as the recording began."""
        grid, *both, _ = self._yielding(past)
        return self.strength[0] * np.stack([np.interp(t, grid, one) for one in both], axis=-1)

    def forces(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the force of a heavy support, of which the sites do not change how it moves."""

        def factor(past: Course) -> Factor:
            grid, _, _, push = self._yielding(past)
            return lambda t: np.interp(t, grid, push)[None, :, None]

        return [Force("1", self.strength[0], {0: 1.0}, None, tuple(map(factor, self.past)))]

    def _yielding(self, past: Course) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Return times, y, y' and -y'' of a support as heavy as a site that does not change how the sites move.

        With U = sum_j u_j, z = y + U is the motion of an absorber whose site moves as U.
        """
        step = self.step / FINE
        total = past.sampled(step)[0].sum(axis=-1)
        rate = np.gradient(total, step)
        z, speed = shaken(total, step, self.omega, self.gamma)
        y, v = z - total, speed - rate
        push = np.gradient(rate, step) + self.omega**2 * y + self.gamma * v
        return past.begin + step * np.arange(len(total)), y, v, push

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return what carries the sites."""
        mass = f"{1 / self.strength[0]:.{DIGITS}g} times a site's mass" if self.strength[0] > 0 else "far heavier"
        own = f"unloaded it would swing at {self.omega:.{DIGITS}g}"
        return [f"all sites hang on a support that sways and is not read, {mass}; {own}"]
