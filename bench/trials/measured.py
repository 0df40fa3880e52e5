"""Measured recordings as cases: each is diagnosed with the equation that is declared for it."""

from __future__ import annotations

import hashlib
import time
from typing import Annotated, Any, Literal

import pydantic

from latticebench.bench.case import Case, Folders, Name, Roots
from latticebench.bench.report.content import content
from latticebench.bench.report.document import to_dict
from latticebench.diagnosis.repair import diagnose
from latticebench.methods.method import Skipped
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.readers import read
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Ends


def _ordered(rows: tuple[int, int]) -> tuple[int, int]:
    if rows[0] >= rows[1]:
        raise ValueError("the first row must come before the last")
    return rows


_ORDERED = pydantic.AfterValidator(_ordered)


class Measured(Case):
    """The diagnosis of a recording; a block of a suite is one of these.

    Attributes:
        name: of the case, and of its published file.
        about: what is declared, in words.
        file: in the folder of recordings.
        rows: from the first to before the last, from 0; all if not given.
        terms, order, ends: the declared equation and the ends of the chain.
    """

    kind: Literal["measured"] = "measured"
    name: Name
    about: str = ""
    file: Annotated[str, pydantic.StringConstraints(pattern=r"^[^\x00]*[^\x00\s][^\x00]*$")]
    rows: Annotated[tuple[pydantic.NonNegativeInt, pydantic.PositiveInt], _ORDERED] | None = None
    terms: str
    order: Annotated[int, pydantic.Field(ge=1, le=2)]
    ends: Ends = "unknown"
    time_limit: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] = 7200.0
    memory_limit: Annotated[int, pydantic.Field(gt=0, lt=2**40)] = 16_384

    @property
    def title(self) -> str:
        """The name and the declared equation in one line."""
        return f"{self.name} | {self.terms}"

    @property
    def roots(self) -> Roots:
        """The diagnosis, and the recording itself."""
        return Roots(__name__, recording=self.file)

    def blank(self) -> dict[str, Any]:
        """Return the names of a result's content: the hash of the file, the diagnosis, and the time that it took."""
        return {"sha256": None, "report": None, "seconds": None, "cpu_seconds": None}

    def run(self, folders: Folders, found: dict[str, Any]) -> None:
        """Read the recording and diagnose it; see `Case.run`."""
        wall, cpu = time.perf_counter(), time.process_time()
        path = folders.data / self.file
        try:
            samples = [self.cut(one) for one in read(path, self.ends)]
        except InputError as error:
            raise Skipped(str(error)) from None
        found["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        found["report"] = to_dict(content(diagnose(library("declared", self.terms), self.order, samples, CATALOGUE)))
        found.update(seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu)

    def cut(self, samples: Samples) -> Samples:
        """Return the rows of samples that are asked for."""
        if self.rows is None:
            return samples
        return samples.of_rows(slice(*self.rows))
