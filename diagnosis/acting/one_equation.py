"""A whole right-hand side that is scaled: another mass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from latticebench.diagnosis.acting.placed import DIGITS, AtOneSite, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect


@dataclass(frozen=True, eq=False, kw_only=True)
class OneEquation(AtOneSite, acts="one equation"):
    """The whole right-hand side of one site is multiplied by 1 + strength."""

    separated_by: ClassVar[str] = (
        "waves of other lengths: another mass answers all forces of its site differently, a defect only the one on the "
        "site itself"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, on a chain of at least two."""
        if effect.texts(scene.chain.order, scene.chain.is_complex) and scene.chain.sites > 1:
            for site in scene.chain.moving:
                yield cls(effect=effect, here=site, strength=(0.0,))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the name of the factor's excess over 1."""
        return ("scale",)

    def scaled(self) -> int:
        """Return the site."""
        return self.here

    def settings(self) -> dict[str, float | int | str]:
        """Return the site and the mass that would answer the same forces so, over that of the others."""
        factor = 1 + self.strength[0]
        return {"site": self.here + 1, "mass_ratio": 1 / factor if factor else float("inf")}

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return the mass."""
        return {"mass_ratio": float(self.settings()["mass_ratio"])}

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return the factor and the mass."""
        factor = 1 + self.strength[0]
        mass = f" (a mass of {1 / factor:.{DIGITS}g} times the others')" if factor > 0 else ""
        return [f"site {self.here + 1}: its whole right-hand side is multiplied by {factor:.{DIGITS}g}{mass}"]
