"""What every case has in common: all that the runner, the store and the key know of one.

A kind of case is a frozen model of the settings that decide its result, in a file of its own with the code that
computes it: a fit of simulated samples (`bench.fitting`), the diagnosis of a recording with a known effect
(`bench.trials.trial`), of one as a laboratory makes it (`bench.trials.laboratory.case`), and of a measured recording
(`bench.trials.measured`). `bench.kinds` lists them.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pydantic

if TYPE_CHECKING:
    from typing import Self

# What can become of a case: besides a result, the method or the trial cannot take such data ("skipped"), an exception,
# a limit, or a worker process that ended by itself.
STATUSES = ("ok", "skipped", "failed", "memory", "timeout", "died")

Number = Annotated[float, pydantic.Field(allow_inf_nan=False)]
# What NumPy draws from and SQLite keeps.
Seed = Annotated[int, pydantic.Field(ge=0, lt=2**63)]
# A name of a file, without its ending.
NAME = r"^\w[\w .+=-]{0,99}$"
Name = Annotated[str, pydantic.Field(pattern=NAME)]
# Where measured recordings lie unless told otherwise.
DATA = Path("data")
# Settings that do not decide the result: two cases that differ in these alone are one.
BESIDES = {"kind", "label", "part", "time_limit", "memory_limit"}
_SORTED = json.JSONEncoder(sort_keys=True)


class Settings(pydantic.BaseModel):
    """A frozen model that refuses keys it does not know, and values of another type: true is not 1, nor is "1"."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=True)

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Self:
        """Return what TOML or JSON has, where a list stands for a tuple.

        Raises:
            pydantic.ValidationError: a key is unknown or missing, or its value is of another type or out of range.
        """
        # A date of TOML's becomes what no key may be.
        return cls.model_validate_json(json.dumps(content, default=lambda value: {"date": str(value)}))


@dataclass(frozen=True)
class Folders:
    """Where relative paths in a case start from.

    Attributes:
        suite: the folder of the suite file, for a user's own methods and systems.
        data: the folder of measured recordings.
        chosen: for methods, where it is another one than that of the suite file.
    """

    suite: Path = Path()
    data: Path = DATA
    chosen: Path | None = None

    @property
    def methods(self) -> Path:
        """Where paths of a user's own methods start from."""
        return self.suite if self.chosen is None else self.chosen


@dataclass(frozen=True)
class Roots:
    """What a result is computed from: its key covers these and all modules of this package that they import.

    Attributes:
        module: the name of the module that computes it.
        method, system: names, or a user's files; empty for none.
        recording: a file of measured data; empty for none.
    """

    module: str
    method: str = ""
    system: str = ""
    recording: str = ""


class Case(Settings):
    """One cell of the matrix: everything that decides its result, and how much it may take.

    Attributes:
        kind: the name of its kind in `bench.kinds`; a field with one possible value in each kind.
        part: the part of the suite that it belongs to, such as a panel of a figure.
        time_limit: seconds of wall time.
        memory_limit: MiB.
    """

    kind: str
    part: str = ""
    time_limit: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] = 120.0
    memory_limit: Annotated[int, pydantic.Field(gt=0, lt=2**40)] = 4096

    @property
    def identity(self) -> str:
        """The settings that decide the result, as text in a fixed order: what two runs of one case have in common."""
        content = self.model_dump(mode="json", exclude=BESIDES, exclude_defaults=True)
        return _SORTED.encode(content)

    @property
    @abstractmethod
    def title(self) -> str:
        """One line that tells the case from the others of its suite."""

    @property
    @abstractmethod
    def roots(self) -> Roots:
        """What the result is computed from, besides these settings."""

    @abstractmethod
    def blank(self) -> dict[str, Any]:
        """Return the content of a result in which nothing is known: every name with None, "" or an empty table."""

    @abstractmethod
    def run(self, folders: Folders, found: dict[str, Any]) -> None:
        """Compute the content of the result, as JSON can hold it.

        Args:
            folders: where relative paths start from.
            found: begins as `blank` and is filled as things become known, so that a failure loses none of them.

        Raises:
            Skipped: the data cannot be taken; the text is the reason.
            Exception: whatever else goes wrong; the runner makes it the status and the reason.
        """


def code_file(name: str) -> str | None:
    """Return the Python file of a user's that a method or system is named by (FILE.py or FILE.py:NAME), or None."""
    path = name.rpartition(":")[0] if ".py:" in name else name
    return path if path.endswith(".py") else None


def plain(value: float) -> float | str | None:
    """Return a number as JSON can hold it: None for NaN, a text for infinity."""
    value = float(value)
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")
