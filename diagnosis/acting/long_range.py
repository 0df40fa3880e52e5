"""A coupling between sites that are far apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed, Summand
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray

# Powers that the search starts from, and the farthest sites that are coupled.
POWERS, FARTHEST = (1.5, 3.0, 5.0), 40


@dataclass(frozen=True, eq=False, kw_only=True)
class LongRange(Placed, acts="long range"):
    """A coupling that falls with the distance: strength * sum over r >= 2 of (u_{n+r} + u_{n-r} - 2 u_n) / r^s.

    Attributes:
        s: the power, dimensionless.
        reach: the largest r.
        open: whether a site beyond an end does not pull; else it repeats what the ends say.
    """

    s: float
    reach: int
    open: bool
    shape: ClassVar[tuple[str, ...]] = ("s",)
    separated_by: ClassVar[str] = "waves of other lengths: what couples far sites depends on it"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return a few powers, with what the ends repeat and without."""
        chain = scene.chain
        reach = min(chain.sites - 1, chain.reach, FARTHEST)
        if effect.texts(chain.order, chain.is_complex) and reach > 2 and len(chain.moving) == chain.sites:
            for open_ in (False, True):
                for s in POWERS:
                    yield cls(effect=effect, s=s, reach=reach, open=open_, strength=(0.0,) * chain.parts)

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and what is beyond the ends."""
        return (self.effect.name, self.open)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the sum."""
        label = f"sum((u[n+r]+u[n-r]-2*u[n])/r**{self.s:.3g}, r>=2)"
        return (label, f"i*{label}")[: chain.parts]

    def forces(self, chain: Chain) -> list[Force]:
        """Return the coupling at each distance; all follow from strength and power."""
        last, found = len(self.strength), []
        for k, a in enumerate(self.strength):
            lead = "i*" if k else ""
            for r in range(2, self.reach + 1):
                size = float(np.exp(np.clip(-self.s * np.log(r), -700.0, 700.0)))
                by = {k: size} | ({last: -a * np.log(r) * size} if a else {})
                for text, weights in self._pulls(lead, r, chain.sites):
                    found.append(Force(text, a * size, by, weights))
        return found

    def _pulls(self, lead: str, r: int, sites: int) -> list[tuple[str, ndarray | None]]:
        if not self.open:
            return [(f"{lead}(u[n+{r}]+u[n-{r}]-2*u[n])", None)]
        place = np.arange(sites)
        return [
            (f"{lead}(u[n+{r}]-u[n])", (place + r < sites).astype(float)),
            (f"{lead}(u[n-{r}]-u[n])", (place - r >= 0).astype(float)),
        ]

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the sum."""
        import sympy

        r = sympy.Symbol("r", integer=True)
        far = sympy.Symbol("u_{n+r}") + sympy.Symbol("u_{n-r}") - 2 * sympy.Symbol("u_{n}")
        total = sympy.Sum(far / r ** sympy.Float(self.s, DIGITS), (r, 2, sympy.oo))
        bodies = [total, sympy.I * total][: chain.parts]
        return [Summand(*one) for one in zip(self.labels(chain), self.strength, bodies, strict=True)]
