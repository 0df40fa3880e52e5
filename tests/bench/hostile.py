"""Methods that misbehave, each in a way of its own, for the tests of the runner."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from latticebench.methods.method import Abilities, Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class Hostile:
    """Does what `deed` says, once the file `gate` is there; `diary` gets a line at the start of each fit."""

    name: ClassVar[str] = "hostile"
    deed: str = "behave"
    seconds: float = 0.0
    diary: str = ""
    gate: str = ""

    @property
    def abilities(self) -> Abilities:
        return Abilities()

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        if self.diary:
            with Path(self.diary).open("a") as diary:
                diary.write(f"{self.deed} {seed} {os.getpid()}\n")
        while self.gate and not Path(self.gate).exists():
            time.sleep(0.02)
        if self.deed == "fail":
            raise RuntimeError("the matrix is on holiday")
        if self.deed == "eat":
            eaten = np.ones(2**28)  # 2 GiB, held until somebody ends it
            time.sleep(1e6 * eaten[0])
        if self.deed == "hang in C":
            ctypes.PyDLL(None).sleep(100_000)  # holds the interpreter's lock
        if self.deed == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.deed == "write":
            data[0].t[:] *= 2
        if self.deed == "nan":
            return Fit(self.name, library, order, np.full(len(library.terms), np.nan), 0.0)
        if self.deed == "complex":
            return Fit(self.name, library, order, np.zeros(len(library.terms)) + 1j, 0.0)
        if self.deed == "object":
            return Fit(self.name, library, order, np.ones(len(library.terms)), 0.0, status=object())  # type: ignore[arg-type]
        time.sleep(self.seconds)
        draw = np.random.default_rng(seed)
        return Fit(self.name, library, order, draw.normal(size=len(library.terms)), 0.5)


METHODS = (Hostile,)
