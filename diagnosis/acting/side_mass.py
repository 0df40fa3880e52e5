"""A mass that is not read, on a spring at one site."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.hanging import APART, FINE, UNTOLD, Hanging, frequencies
from latticebench.diagnosis.acting.placed import DIGITS, AtOneSite, Force, Placed
from latticebench.diagnosis.acting.scene import Chain, Course, Scene
from latticebench.methods.engine.dynamics import Factor
from latticebench.methods.engine.resonator import Absorber, Resonator, shaken
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from typing import Self

    from jaxtyping import Float
    from numpy import ndarray

# Frequencies are tried from this share of the main one up to so many times the highest.
LOWEST, HIGHEST = 0.4, 1.6
# Sharper ones about each of them: how far apart, and how many to either side.
SHARP, ASIDE = 1.02, 3


@dataclass(frozen=True, eq=False, kw_only=True)
class SideMass(AtOneSite, Hanging, acts="side mass"):
    """A mass that hangs on one site by a spring and a dashpot, and is not read: the absorber of Frahm and Den Hartog.

    See `methods.engine.resonator` for the equations; the strength is its mass in units of the site's.

    Attributes:
        drag: of the mass on its own, one over the unit of time; the frequency is that on a site that is held.
    """

    drag: float
    shape: ClassVar[tuple[str, ...]] = ("omega", "gamma", "drag")
    separated_by: ClassVar[str] = "a look at the site: what swings there is not in the recording"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return each site, with frequencies about those of the motion."""
        if not scene.terms(effect) or not scene.main:
            return
        for omega in frequencies(LOWEST * scene.main, HIGHEST * scene.top):
            for here in scene.chain.moving:
                yield cls(
                    effect=effect, here=here, omega=float(omega), gamma=float((APART - 1) * omega), drag=0.0,
                    past=scene.past, step=scene.step, strength=(0.0,),
                )  # fmt: skip

    def sharper(self) -> Iterator[Self]:
        """Return it with less losses, at frequencies about its own."""
        for omega in self.omega * SHARP ** np.arange(-ASIDE, ASIDE + 1.0):
            yield replace(self, omega=float(omega), gamma=float((SHARP - 1) * omega))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the number is."""
        return ("mass beside the site's",)

    @property
    def possible(self) -> bool:
        """Whether there is a mass, and it swings and loses."""
        losses = self.gamma, self.drag
        swings = abs(sum(losses)) < self.omega
        return self.strength[0] >= 0 and swings and min(losses) > -UNTOLD * self.omega

    def resonator(self, chain: Chain) -> Resonator:
        """Return what swings at the site."""
        return Absorber((chain.moving.index(self.here),), *map(float, self.numbers))

    def unread(self, past: Course, t: Float[ndarray, "*rows"]) -> Float[ndarray, "*rows 2"]:
        """Return about where the mass would be, if it was at rest as the recording began, and its velocity."""
        grid, *both = self._followed(past)
        return np.stack([np.interp(t, grid, one) for one in both], axis=-1)

    def forces(self, chain: Chain) -> list[Force]:
        """Return the force of a light mass, which does not change how its site moves."""
        mass, share = self.strength[0], self.share(chain)

        def factor(past: Course) -> Factor:
            grid, y, v = self._followed(past)
            pull = self.omega**2 * y + self.gamma * v
            return lambda t: np.interp(t, grid, pull)[None, :, None]

        pulls = (-(self.omega**2), "u[n]"), (-self.gamma, "v[n]")
        found = [Force(text, mass * by, {0: by}, share) for by, text in pulls]
        return [*found, Force("1", mass, {0: 1.0}, share, tuple(map(factor, self.past)))]

    def _followed(self, past: Course) -> tuple[ndarray, ndarray, ndarray]:
        """Return times, y and y' of a mass that is at rest as the recording begins."""
        u = past.sampled(step := self.step / FINE)[0, :, self.here]
        return past.begin + step * np.arange(len(u)), *shaken(u, step, self.omega, self.gamma, self.drag)

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return what hangs where."""
        size = f"{self.strength[0]:.{DIGITS}g} times the site's"
        swing = f"with the site held it would swing at {self.omega:.{DIGITS}g}"
        return [f"a mass that is not read hangs on site {self.here + 1} by a spring, {size}; {swing}"]
