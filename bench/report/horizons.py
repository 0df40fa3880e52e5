"""How the search went: the horizons that the models were followed over, and the candidates of the last one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from latticebench.bench.report.document import Content, Number

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis


class Leading(Content):
    """A model that was carried along: its effects, and how far it was behind the best one (natural logarithm)."""

    effects: tuple[str, ...]
    behind: Number


class Candidate(Content):
    """An effect that was tried beside those of the best model.

    Attributes:
        effect: its name.
        gain: natural logarithm of how much likelier it can make the readings, by a score test.
        price: what it has to gain, for it is one of many that were tried.
    """

    effect: str
    gain: Number
    price: Number


class HorizonReport(Content):
    """One stage of the search.

    Attributes:
        samples: length of the pieces that models were followed over.
        periods: the same in periods of the motion.
        models: the best one first.
        tried: candidates for the best model, by how far their gain is above their price.
        misfit: whether the best model leaves so much more than noise that effects must take away a share of it.
    """

    samples: int
    periods: Number
    models: tuple[Leading, ...]
    tried: tuple[Candidate, ...]
    misfit: bool = False


def horizons(diagnosis: Diagnosis) -> tuple[HorizonReport, ...]:
    """Return the stages of the search, the shortest horizon first."""
    return tuple(
        HorizonReport(
            samples=one.samples, periods=one.periods,
            models=tuple(Leading(effects=effects, behind=behind) for effects, behind in one.models),
            tried=tuple(Candidate(effect=each.name, gain=each.gain, price=each.price) for each in one.tried),
            misfit=one.misfit,
        )
        for one in diagnosis.horizons
    )  # fmt: skip
