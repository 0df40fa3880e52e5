"""Eigenfrequencies and decay rates of the models beside the peaks of the recording's spectrum."""

from __future__ import annotations

from typing import TYPE_CHECKING

from latticebench.bench.report.document import Content, Number

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis


class Mode(Content):
    """An angular frequency, and the rate 1/time at which a swing of it decays; negative where it grows."""

    frequency: Number
    decay: Number


class Modes(Content):
    """What swings.

    Attributes:
        recording: the peaks of the recording's spectrum, without decay rates.
        before, after: modes of the declared equation and of the last model, for swings as large as the recording has.
    """

    recording: tuple[Mode, ...]
    before: tuple[Mode, ...]
    after: tuple[Mode, ...]


def modes(diagnosis: Diagnosis) -> Modes:
    """Return the peaks and modes of a diagnosis, by frequency."""
    every = [
        tuple(
            Mode(frequency=one.frequency, decay=one.decay)
            for one in sorted(found, key=lambda one: float(one.frequency))
        )
        for found in diagnosis.modes
    ]
    return Modes(recording=every[0], before=every[1], after=every[2])
