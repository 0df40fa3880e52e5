"""`latticebench limit`: what the data allow at best."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.arguments import asked, case_of, numbers, told
from latticebench.bench.cli.options import AnyEnds, JsonOut, Order, Settings, Terms, Yes, check_places, complete_systems
from latticebench.bench.cli.options import Library as LibraryName
from latticebench.bench.cli.reading import Columns, Scale, Sort, Time, layout_of, read_told
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.bench.fitting import FitCase
    from latticebench.bench.limit import Limit
    from latticebench.methods.method import Fit
    from latticebench.systems.lattice import Library
    from latticebench.systems.samples import Samples

EPILOG = (
    "Examples:  latticebench limit --system phi4 --set C=2 --library lib4 --noise 0.01\n\n"
    "           latticebench limit phi4.csv --system phi4 --library lib2 --ends free"
)


def limit(
    files: Annotated[
        list[Path] | None, typer.Argument(help="Recorded samples; without any, samples of --system are taken.")
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(
            help="What moves; with files, where order and libraries come from.", autocompletion=complete_systems
        ),
    ] = None,
    library: LibraryName = None,
    terms: Terms = None,
    order: Order = None,
    ends: Annotated[
        AnyEnds | None,
        typer.Option(
            help="How the chain ends, as far as the fit knows: the system's own, with files unknown, if not given."
        ),
    ] = None,
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
    sort: Sort = False,
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
    layout = layout_of(time, columns, scale, sort)
    if files:
        for name in described:
            raise InputError(f"--{name}: files are given, whose samples are as they are; leave it out, or the files")
        note, bound_at, warnings = _of_recordings(read_told(files, ends or "unknown", layout), candidates, order)
    elif known is None or system is None:
        raise InputError("give one or more files, or --system: the bound is about samples")
    else:
        described.pop("set", None)
        case = case_of(
            system=system, parameters=numbers(given), library=candidates.name, known_ends=ends != "unknown",
            terms=candidates.texts if terms is not None else (), ends=None if ends == "unknown" else ends,
            **{"noise": 0.01, **described},
        )  # fmt: skip
        note, bound_at = _of_simulated(case, None if yes else case.sites or known.sites)
        warnings = ()
    _report(note, bound_at, target, json_out, warnings)


# A bound for so many times the samples in the same time, and for a record so many times as long.
BoundAt = Callable[[int, int], "Limit"]


def _of_recordings(data: Sequence[Samples], candidates: Library, order: int) -> tuple[str, BoundAt, tuple[str, ...]]:
    """Return where the bound of recorded samples is taken, the bound, and why it may not hold."""
    from latticebench.bench.limit import denser
    from latticebench.bench.noise import left_by
    from latticebench.bench.report.screen import waiting

    with waiting(f"fitting {len(candidates.terms)} terms"), redirect_stdout(sys.stderr):
        fit = _followed(data, candidates, order)
    left = left_by(data, fit)

    def bound_at(more: int, longer: int) -> Limit:
        if longer > 1:
            raise InputError("nobody knows how the motion goes on after the record")
        return denser(data, fit, more, left.noise)

    note = (
        f"{data[0].source}: bound along the motion that {fit.method!r} fits to the samples, with the noise that it "
        "leaves" + ("" if fit.status == "ok" else f" ({fit.status})")
    )
    return "\n".join([note, *(f"noise of {line}" for line in left.lines)]), bound_at, left.warning


def _followed(data: Sequence[Samples], candidates: Library, order: int) -> Fit:
    """Fit by the method that gives the motion it follows."""
    from latticebench import methods
    from latticebench.methods.method import solve

    method = next(kind() for kind in methods.registered().values() if kind().abilities.motion)
    with told(data, None, "the fit"):
        return solve(method, data, candidates, order, 1)


def _of_simulated(case: FitCase, sites: int | None) -> tuple[str, BoundAt]:
    """Return where the bound of simulated samples is taken, and the bound; without `sites` they may be any size."""
    from latticebench.bench.effort import check_size
    from latticebench.bench.fitting import bound

    if sites is not None:
        check_size(case, sites, case.system)

    def bound_at(more: int, longer: int) -> Limit:
        changed = {"samples": case.samples * more * longer, "span": case.span * longer}
        return bound(case.model_copy(update=changed), Path())

    return f"{case.data}: bound at the truth of the system", bound_at


def _report(note: str, bound_at: BoundAt, target: float, json_out: str | None, warnings: tuple[str, ...]) -> None:
    """Take the bound and show it, or write it as JSON."""
    from latticebench.bench.limit import design
    from latticebench.bench.report.screen import show_limit, waiting
    from latticebench.systems.files import write_text

    with waiting("taking the bound"):
        found = bound_at(1, 1)
        needed = design(bound_at, target=target)
    if json_out != "-":
        show_limit(found, needed, note, warnings)
    if json_out is None:
        return
    from latticebench.bench.report.document import provenance, to_json
    from latticebench.bench.report.outputs import limit_document

    text = to_json(limit_document(found, needed, note, provenance([1]), warnings))
    if json_out == "-":
        print(text, end="")
    else:
        write_text(Path(json_out), text)
