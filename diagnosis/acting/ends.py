"""Other ends than declared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from latticebench.diagnosis.acting.placed import Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.stencil import Ends

OTHERS: tuple[Ends, ...] = ("free", "fixed", "periodic", "antiperiodic")


@dataclass(frozen=True, eq=False, kw_only=True)
class OtherEnds(Placed, acts="ends"):
    """The chain ends in another way than declared.

    Attributes:
        way: the ends that it has.
    """

    way: Ends
    separated_by: ClassVar[str] = "a motion far from the ends, and one at the ends"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return all other ends, where some are declared and a term sees beyond them."""
        chain = scene.chain
        if chain.ends != "unknown" and chain.sites > 2 and any("n+" in text or "n-" in text for text in scene.texts):
            for way in OTHERS:
                if way != chain.ends:
                    yield cls(effect=effect, way=way, strength=())

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and the ends."""
        return (self.effect.name, self.way)

    @property
    def from_the_start(self) -> bool:
        """Whether it is: of a motion at the ends, wrong ones make another coupling."""
        return True

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return nothing: no number belongs to it."""
        return ()

    def other_ends(self) -> Ends:
        """Return the ends."""
        return self.way

    def settings(self) -> dict[str, float | int | str]:
        """Return the ends."""
        return {"ends": self.way}

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return the ends."""
        return [f"the ends are {self.way}"]
