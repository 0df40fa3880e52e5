"""The models of a horizon: what they are worth, and which of them lead."""

from __future__ import annotations

from collections.abc import Iterable

from latticebench.diagnosis import rules
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.worth import Worth, same


class Pool:
    """Fits of models on one horizon, of each model the best.

    Attributes:
        worth: what models are worth beside the fit of least cost.
    """

    def __init__(self, problem: Problem, fits: Iterable[Fitted]) -> None:
        self.worth = Worth(problem)
        self._kept: dict[tuple[str, ...], Fitted] = {}
        for one in sorted(fits, key=lambda one: one.cost):
            self.keep(one)

    def __contains__(self, model: Model) -> bool:
        return model.key in self._kept

    def find(self, model: Model) -> Fitted | None:
        """Return the fit of a model, or None."""
        return self._kept.get(model.key)

    def keep(self, one: Fitted) -> None:
        """Add a fit, unless there is a better one of the same model."""
        key = one.model.key
        if key not in self._kept or self.worth.better(one, self._kept[key]):
            self._kept[key] = one
            self.worth = Worth(self.worth.problem, min(self._kept.values(), key=lambda kept: kept.cost))

    def leading(self) -> list[Fitted]:
        """Return the best models that differ in what they say of the readings.

        Where all of these may stand in for something else, by a frequency, a time or a delay of their own, the best one
        that may not goes along: on short horizons it takes several effects to do what one such influence does.

        So does the best one that has at least two effects less than each of these, if it is hardly behind: on short
        horizons several effects may do what one does, and a little more.
        """
        found: list[Fitted] = []
        plain: Fitted | None = None
        for one in sorted(self._kept.values(), key=self.worth.value):
            if plain is None and not one.model.may_stand_in:
                plain = one
            if len(found) < rules.RIVALS and not any(same(one, other) for other in found):
                found.append(one)
        if plain is not None and all(one.model.may_stand_in for one in found):
            behind = self.worth.value(plain) - self.worth.value(found[0])
            found += [plain] if behind <= rules.PLAINER else []
        found += self._leaner(found)
        return sorted(found, key=self.worth.value)

    def _leaner(self, leading: list[Fitted]) -> list[Fitted]:
        most = min((len(one.model.effects) for one in leading), default=0) - 2
        lean = [one for one in self._kept.values() if len(one.model.effects) <= most]
        best = min(lean, key=self.worth.value, default=None)
        if best is None or self.worth.value(best) - self.worth.value(leading[0]) > rules.LEANER:
            return []
        return [best]
