"""`latticebench limit`: what the data allow at best."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.arguments import asked, kept, numbers
from latticebench.bench.cli.options import (
    AnyEnds,
    JsonOut,
    Order,
    Settings,
    Terms,
    Yes,
    check_places,
    complete_systems,
    place,
)
from latticebench.bench.cli.options import Library as LibraryName
from latticebench.bench.cli.reading import (
    Between,
    Columns,
    Scale,
    Sort,
    Time,
    TimeScale,
    Turn,
    layout_of,
    read_told,
)
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.bench.bounds import BoundOf
    from latticebench.bench.limit import Limit
    from latticebench.systems.lattice import Library
    from latticebench.systems.samples import Samples

EPILOG = (
    "Examples:  latticebench limit --system phi4 --set C=2 --library lib4 --noise 0.01\n\n"
    "           latticebench limit phi4.csv --system phi4 --library lib2 --ends free"
)

System = Annotated[
    str | None,
    typer.Option(help="What moves; with files, where order and libraries come from.", autocompletion=complete_systems),
]
Ends = Annotated[
    AnyEnds | None,
    typer.Option(
        help="How the chain ends, as far as the fit knows: the system's own, with files unknown, if not given."
    ),
]
Recorded = Annotated[
    list[Path] | None,
    typer.Argument(parser=place, help="Recorded samples; without any, samples of --system are taken."),
]


def limit(
    files: Recorded = None,
    system: System = None,
    library: LibraryName = None,
    terms: Terms = None,
    order: Order = None,
    ends: Ends = None,
    target: Annotated[float, typer.Option(help="Wanted relative error of the coefficients.")] = 0.01,
    given: Settings = None,
    sites: Annotated[int | None, typer.Option(help="Number of sites N.")] = None,
    samples: Annotated[int | None, typer.Option(help="Number of sample times; 50 if not given.")] = None,
    span: Annotated[float | None, typer.Option(help="Length of the record; 10 if not given.")] = None,
    noise: Annotated[
        float | None, typer.Option(help="Noise level: sigma over the RMS about the mean; 0.01 if not given.")
    ] = None,
    trajectories: Annotated[int | None, typer.Option(help="Number of trajectories; 1 if not given.")] = None,
    velocities: Annotated[bool | None, typer.Option(help="Whether velocities are seen (second-order systems).")] = None,
    initial: Annotated[str | None, typer.Option(help="Initial state; the system's first if not given.")] = None,
    time: Time = None,
    columns: Columns = None,
    scale: Scale = "1",
    time_scale: TimeScale = "1",
    sort: Sort = False,
    turn: Turn = 0.0,
    between: Between = None,
    json_out: JsonOut = None,
    yes: Yes = False,
) -> None:
    """Show how well any method could know the coefficients from such samples, and what would be needed for more.

    Options from --set to --initial are about samples of a system; of recorded ones everything is known but their
    noise, which is what a fit leaves at each sensor.
    """
    check_places([*(files or ()), system], json=json_out)
    known, candidates, order = asked(system, library, terms, order)
    simulated = {
        "set": given, "sites": sites, "samples": samples, "span": span, "noise": noise,
        "trajectories": trajectories, "velocities": velocities, "initial": initial,
    }  # fmt: skip
    described = {name: value for name, value in simulated.items() if value is not None}
    layout = layout_of(time, columns, scale, sort, turn, time_scale, between)
    if files:
        for name in described:
            raise InputError(f"--{name}: files are given, whose samples are as they are; leave it out, or the files")
        bound = _of_recordings(read_told(files, ends or "unknown", layout), candidates, order)
    elif known is None or system is None:
        raise InputError("give one or more files, or --system: the bound is about samples")
    elif layout != layout_of():
        raise InputError("options such as --time and --scale say how files are read: give files, or leave them out")
    else:
        described.pop("set", None)
        bound = _of_simulated(
            None if yes else sites or known.sites,
            system=system, parameters=numbers(given), library=candidates.name, known_ends=ends != "unknown",
            terms=candidates.texts if terms is not None else (), ends=None if ends == "unknown" else ends,
            **{"noise": 0.01, **described},
        )  # fmt: skip
    _report(bound, target, json_out)


def _of_recordings(data: Sequence[Samples], candidates: Library, order: int) -> BoundOf:
    """Return the bound of recordings, while a terminal is told what is waited for."""
    from latticebench.bench import calls
    from latticebench.bench.report.screen import waiting

    with waiting(f"fitting {len(candidates.terms)} terms"), redirect_stdout(sys.stderr):
        return calls.bound(data, candidates, order)


def _of_simulated(size: int | None, **described: Any) -> BoundOf:
    """Return the bound of simulated samples of so many sites; without `size` they may be any number."""
    from latticebench.bench.bounds import BoundOf
    from latticebench.bench.calls import case_of
    from latticebench.bench.effort import check_size
    from latticebench.bench.fitting import bound

    case = case_of(**described)
    if size is not None:
        check_size(case, size, case.system)

    def bound_at(more: int, longer: int) -> Limit:
        changed = {"samples": case.samples * more * longer, "span": case.span * longer}
        return bound(case.model_copy(update=changed), Path())

    return BoundOf(bound_at, f"{case.data}: bound at the truth of the system", ())


def _report(bound: BoundOf, target: float, json_out: str | None) -> None:
    """Take the bound and show it, or write it as JSON."""
    from latticebench.bench.limit import design
    from latticebench.bench.report.screen import show_limit, waiting
    from latticebench.systems.files import write_text

    with waiting("taking the bound"):
        found = bound.at(1, 1)
        needed = design(bound.at, target=target)
    text = ""
    failures: list[str] = []
    # The file first: the screen may be full, or its reader stop reading.
    if json_out is not None:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import limit_document

        text = to_json(limit_document(found, needed, bound, provenance([1])))
        if json_out != "-":
            with kept(failures):
                write_text(Path(json_out), text)
    if json_out == "-":
        print(text, end="")
    else:
        show_limit(found, needed, bound.note, bound.warnings, bound.units)
    if failures:
        raise InputError("; ".join(failures))
