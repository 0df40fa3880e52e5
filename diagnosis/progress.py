"""How far a search has come: the horizons that it has been through, and the models that it goes on with."""

from __future__ import annotations

from dataclasses import dataclass

from latticebench.diagnosis.fitting import Fitted


@dataclass(frozen=True)
class Tried:
    """A candidate of the best model of a horizon.

    Attributes:
        name: of the effect.
        gain: its score, in nats.
        price: what it has to gain: what chance alone may gain, more where others nearly like it gain, too; or, if that
            is larger, the share of a misfit that it has to take away.
    """

    name: str
    gain: float
    price: float


@dataclass(frozen=True)
class Horizon:
    """A horizon that the search has been through.

    Attributes:
        samples: rows of the longest piece.
        periods: its length in periods of the main frequency.
        models: effects of the models that went on, and how many nats each was behind the best.
        tried: candidates of the best model, the best first.
        misfit: whether the best model leaves so much more than noise that effects must take away a share of it.
    """

    samples: int
    periods: float
    models: tuple[tuple[tuple[str, ...], float], ...]
    tried: tuple[Tried, ...]
    misfit: bool = False


@dataclass(frozen=True, eq=False)
class Found:
    """How far a search has come.

    Attributes:
        before: the declared equation on the longest horizon on which it could be followed.
        models: the best models on the last horizon, the best first.
        horizons: those that were gone through.
        whole: whether the last one is the whole recordings, or as much of them as unknown ends allow.
    """

    before: Fitted
    models: tuple[Fitted, ...]
    horizons: tuple[Horizon, ...]
    whole: bool = False
