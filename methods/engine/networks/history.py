"""A fit's history while it is being written."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from latticebench.methods.method import History


class HistoryLog:
    """Records loss and coefficients as an optimiser goes on, of one network or of several members.

    Attributes:
        every: steps between two records.
    """

    def __init__(self, every: int, since: float) -> None:
        """Start the clock at `since`, a value of `time.perf_counter()`."""
        self.every, self.since = every, since
        self.step: list[int] = []
        self.seconds: list[float] = []
        self.loss: list[Any] = []
        self.coefficients: list[np.ndarray] = []

    def due(self, step: int) -> bool:
        """Return whether a step is to be recorded."""
        return step >= (self.step[-1] if self.step else -self.every) + self.every

    def note(self, step: int, loss: Any, coefficients: np.ndarray, *, always: bool = False) -> None:
        """Record a step if it is due; a step that is recorded already is left as it is.

        Args:
            step: its number.
            loss: a number, or one per member (K,).
            coefficients: (J,), or one row per member (K, J).
            always: record it even though it is not due.
        """
        if self.due(step) or (always and step > self.step[-1]):
            self.step.append(step)
            self.seconds.append(time.perf_counter() - self.since)
            self.loss.append(loss)
            self.coefficients.append(np.array(coefficients))

    def history(self, member: int | None = None) -> History:
        """Return the records, of one member where there are several."""
        of = ... if member is None else np.s_[:, member]
        return History(
            np.array(self.step, dtype=float),
            np.array(self.seconds),
            np.array(self.loss)[of],
            np.array(self.coefficients)[of],
        )
