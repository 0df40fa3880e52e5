"""Laboratory recordings as cases: each is made, diagnosed with its declared equation, and judged by what is in it."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from latticebench.bench.axes import Listed, Seeds
from latticebench.bench.case import Case, Folders, Roots, Seed, Settings, plain
from latticebench.bench.trials.laboratory.effects import ANY, ASKED, MOST_EFFECTS, NONE
from latticebench.bench.trials.laboratory.instruments import EVERY_KIND, HELD_OUT, KINDS, Kind
from latticebench.bench.trials.laboratory.judging import Finding, findings, residual, written
from latticebench.bench.trials.laboratory.making import LabRecording, make_recording
from latticebench.diagnosis.repair import diagnose, shortfalls
from latticebench.methods.method import Skipped
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError, unknown

TIME_LIMIT = 900.0


class Laboratory(Case):
    """The diagnosis of a recording as a laboratory makes it.

    Attributes:
        instrument: its kind; "any" for one of those that are not held out.
        effects: their names with a + between them; "none" for none, "any" for a drawn number of drawn ones.
        sites: N; drawn if 0.
        seed: of the recording.
    """

    kind: Literal["laboratory"] = "laboratory"
    instrument: str = ANY
    effects: str = ANY
    sites: pydantic.NonNegativeInt = 0
    seed: Seed = 1
    time_limit: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] = TIME_LIMIT

    @property
    def title(self) -> str:
        """The instrument, the effects and the seed in one line."""
        return f"laboratory {self.instrument} | {self.effects} | seed {self.seed}"

    @property
    def roots(self) -> Roots:
        """The diagnosis and the maker of recordings."""
        return Roots(__name__)

    def blank(self) -> dict[str, Any]:
        """Return the names of a result's content; see `run`."""
        return {
            "recording": None, "truth": None, "verdict": None, "partly": None, "findings": None,
            "noise_found": None, "noise_true": None, "residual_before": None, "residual_after": None,
            "pieces": None, "forecast_before": None, "forecast_after": None, "seconds": None, "cpu_seconds": None,
        }  # fmt: skip

    def recording(self) -> LabRecording:
        """Make the recording.

        Raises:
            Skipped: none with these effects could be made.
        """
        kinds: dict[str, Kind] = {kind: kind for kind in EVERY_KIND}
        effects = None if self.effects == ANY else [] if self.effects == NONE else self.effects.split("+")
        try:
            return make_recording(self.seed, kinds.get(self.instrument), effects, sites=self.sites or None)
        except InputError as error:
            raise Skipped(str(error)) from None

    def run(self, folders: Folders, found: dict[str, Any]) -> None:  # noqa: ARG002
        """Make the recording and diagnose it; see `Case.run`. Residuals are in units of the noise that was added.

        `pieces` is how many pieces of the recording the last model was followed over.
        """
        one = self.recording()
        found.update(recording=about(one), truth=written(one), noise_true=one.noise.tolist())
        wall, cpu = time.perf_counter(), time.process_time()
        diagnosis = diagnose(one.declared, one.order, [one.samples], CATALOGUE)
        found.update(seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu)
        found.update(
            verdict=diagnosis.verdict, partly=list(shortfalls(diagnosis)),
            findings=[_plain(each) for each in findings(diagnosis)],
            noise_found=[plain(float(size)) for size in diagnosis.noise],
            residual_before=plain(residual(diagnosis.before, one.noise)),
            residual_after=plain(residual(diagnosis.after, one.noise)), pieces=diagnosis.after.pieces,
            forecast_before=plain(diagnosis.forecast[0]), forecast_after=plain(diagnosis.forecast[1]),
        )  # fmt: skip


def about(one: LabRecording) -> dict[str, Any]:
    """Return what a recording is, besides its effects, as JSON can hold it."""
    chain = one.chain
    return {
        "instrument": one.instrument, "declared": "; ".join(one.declared.texts), "sites": chain.sites,
        "ends": one.samples.ends, "readings": len(one.samples.t), "periods": chain.span * chain.fast / (2 * np.pi),
        "unit": chain.unit,
    }  # fmt: skip


def _plain(one: Finding) -> dict[str, Any]:
    """Return a finding as JSON can hold it."""
    values = {name: [plain(value), plain(error)] for name, (value, error) in one.values.items()}
    return {"name": one.name, "site": one.site, "values": values, "alternatives": list(one.alternatives)}


class Batch(Settings):
    """A block of laboratory recordings in a suite: every combination of the lists is one.

    Attributes:
        instruments: kinds; "any" for one that is drawn, "each" for all that may be, "held-out" for those held out.
        effects: names with a + between them; "none" for none, "any" for a drawn number of drawn ones.
        sites: N; drawn if 0.
        seeds: of the recordings.
    """

    part: str = ""
    instruments: Listed[str] = [ANY]
    effects: Listed[str] = [ANY]
    sites: Listed[int] = [0]
    seeds: Seeds = [1]
    time_limit: float = TIME_LIMIT
    memory_limit: int = 4096

    def cases(self, where: str) -> Iterator[Laboratory]:
        """Return every combination.

        Args:
            where: the place of the block, for errors.

        Raises:
            InputError: an instrument or an effect is unknown.
        """
        groups: dict[str, tuple[Kind, ...]] = {"each": KINDS, "held-out": HELD_OUT}
        instruments = [kind for name in self.instruments for kind in groups.get(name, (name,))]
        for name in instruments:
            if name not in (ANY, *EVERY_KIND):
                raise unknown("instrument", name, [ANY, *groups, *EVERY_KIND], where)
        for text in self.effects:
            names = [] if text in (ANY, NONE) else text.split("+")
            for name in names:
                if name not in ASKED or len(names) > MOST_EFFECTS:
                    raise unknown("effect", name, [ANY, NONE, *ASKED], where)
        for instrument, effects, sites, seed in itertools.product(instruments, self.effects, self.sites, self.seeds):
            yield Laboratory(
                instrument=instrument, effects=effects, sites=sites, seed=seed, part=self.part,
                time_limit=self.time_limit, memory_limit=self.memory_limit,
            )  # fmt: skip
