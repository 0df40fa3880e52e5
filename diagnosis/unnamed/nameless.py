"""What has no name: said in words or by its term, each of its numbers alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from latticebench.diagnosis.acting import Chain, Placed, Scene
from latticebench.systems.effects import Effect

EFFECT = Effect("unnamed", "1")


@dataclass(frozen=True, eq=False, kw_only=True)
class Nameless(Placed):
    """A sum of forces or of errors of the readings, each with a strength.

    Attributes:
        said: in words, or as a term.
        here: the only site, from 0; None where there is no such site.
    """

    said: str
    here: int | None = None

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:  # noqa: ARG003
        """Return nothing: it is in no catalogue."""
        return iter(())

    @property
    def site(self) -> int | None:
        """The only site, from 0."""
        return self.here

    @property
    def place(self) -> tuple[object, ...]:
        """What it is, and where."""
        return (self.said, self.here)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what it is."""
        return (self.said,) * len(self.strength)
