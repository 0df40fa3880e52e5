"""A term at every site, with a coefficient of its own at each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from latticebench.diagnosis.acting.one_site import alike
from latticebench.diagnosis.acting.placed import Force, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.stencil import evaluate
from latticebench.systems.terms import Term


@dataclass(frozen=True, eq=False, kw_only=True)
class EverySite(Placed, acts="every site"):
    """A term at every site with a coefficient of its own.

    Attributes:
        texts: T, or T and i*T for complex coefficients.
        whole: whether the coefficients are free; else only their deviations from a mean that the model has already, so
            that those of the last site are what makes their sum 0.
    """

    texts: tuple[str, ...]
    whole: bool
    local: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the formula and its like, on a chain of at least three sites: with fewer, one site can be named.

        Where all declared terms are linear, constants do what the sensors' offsets do: none.
        """
        texts, chain = scene.terms(effect), scene.chain
        if texts == ("1",) and _linear(scene):
            return
        if texts and len(chain.moving) > 2 and len(chain.moving) == chain.sites:
            whole = not set(texts) <= set(scene.texts)
            yield cls(
                effect=effect, texts=texts, whole=whole, strength=(0.0,) * ((chain.sites - (not whole)) * len(texts))
            )
            for text in alike(texts, scene):
                yield OtherCoefficients(effect=effect, texts=(text,), whole=False, strength=(0.0,) * (chain.sites - 1))

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the terms with their sites."""
        return tuple(f"{text} at site {k + 1}" for text in self.texts for k in range(chain.sites - (not self.whole)))

    def forces(self, chain: Chain) -> list[Force]:
        """Return a term for every site."""
        each = np.eye(chain.sites)
        if not self.whole:
            each = each[:-1] - each[-1]
        places = [(text, row) for text in self.texts for row in each]
        return [Force(text, self.strength[k], {k: 1.0}, row) for k, (text, row) in enumerate(places)]

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return how the coefficients scatter."""
        each = np.reshape(self.strength, (len(self.texts), -1))
        named = " and ".join(self.texts)
        if self.whole:
            about = f"mean {np.mean(each):.3g}, standard deviation {np.std(each):.3g}"
        else:
            each = np.concatenate([each, -np.sum(each, axis=1, keepdims=True)], axis=1)
            about = (
                f"deviations from their mean, which belongs to {named} itself; standard deviation {np.std(each):.3g}"
            )
        return [f"every site has {named} besides, with a coefficient of its own: {about}"]


@dataclass(frozen=True, eq=False, kw_only=True)
class OtherCoefficients(EverySite):
    """A declared term that has a coefficient of its own at each site."""

    general: ClassVar[bool] = True

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and its term."""
        return (self.effect.name, *self.texts)


def _linear(scene: Scene) -> bool:
    """Return whether all declared terms of a real lattice of first order add up as fields do."""
    terms, zero = [Term(text) for text in scene.texts], np.zeros((1, scene.chain.sites))
    place = np.arange(scene.chain.sites)

    def values(u: np.ndarray) -> np.ndarray:
        return np.asarray(evaluate(terms, u[None], None, zero, np.zeros(1), ends=scene.chain.ends))

    one, two = np.cos(1.3 * place + 0.4), np.sin(0.7 * place**2 + 0.2)
    return bool(np.allclose(values(one + two), values(one) + values(two)))
