"""`latticebench limit`: what the data allow at best."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.arguments import asked, case_of, jsonable, numbers, told
from latticebench.bench.cli.options import AnyEnds, Settings, complete_libraries, complete_systems
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.bench.limit import Design, Limit
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
    library: Annotated[
        str | None, typer.Option(help="A library of the system.", autocompletion=complete_libraries)
    ] = None,
    terms: Annotated[str | None, typer.Option(help="Terms of your own, with ; between them.")] = None,
    order: Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")] = None,
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
        float | None,
        typer.Option(help="Noise level: sigma over the RMS of the field about its mean; 0.01 if not given."),
    ] = None,
    trajectories: Annotated[int | None, typer.Option(help="Number of trajectories; 1 if not given.")] = None,
    velocities: Annotated[bool | None, typer.Option(help="Whether velocities are seen (second-order systems).")] = None,
    initial: Annotated[str | None, typer.Option(help="Initial state; the system's first if not given.")] = None,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="OUT", help="Write it as JSON to a file, or - for the screen.")
    ] = None,
) -> None:
    """Say how well any method could know the coefficients from such samples, and what would be needed for more.

    Options from --set to --initial are about samples of a system; of recorded ones everything is known but their noise, which
    is taken from a fit.
    """
    from latticebench.bench.limit import denser, design
    from latticebench.bench.screen import show_limit, waiting
    from latticebench.systems.files import write_text

    known, candidates, order = asked(system, library, terms, order)
    only_simulated = {
        "--set": given, "--sites": sites, "--samples": samples, "--span": span, "--noise": noise,
        "--trajectories": trajectories, "--velocities": velocities, "--initial": initial,
    }  # fmt: skip
    if files:
        for name, value in only_simulated.items():
            if value is not None:
                raise InputError(f"{name}: files are given, whose samples are as they are; leave it out, or the files")
        from latticebench.systems.readers import read_all

        data = read_all(files, ends or "unknown")
        with waiting(f"fitting {len(candidates.terms)} terms"), redirect_stdout(sys.stderr):
            fit = _followed(data, candidates, order)

        def bound_at(more: int, longer: int) -> Limit:
            if longer > 1:
                raise InputError("nobody knows how the motion goes on after the record")
            return denser(data, fit, more)

        note = f"{data[0].source}: bound along the motion that {fit.method!r} fits to the samples, with the noise that it leaves"
        note += "" if fit.status == "ok" else f" ({fit.status})"
    else:
        if known is None or system is None:
            raise InputError("give one or more files, or --system: the bound is about samples")
        from latticebench.bench.fitting import bound

        case = case_of(
            system=system, parameters=numbers(given), sites=sites, initial=initial, library=candidates.name,
            terms=candidates.texts if terms is not None else (), known_ends=ends != "unknown",
            ends=None if ends == "unknown" else ends,
            **{
                name: value for name, value in (
                    ("samples", samples), ("span", span), ("trajectories", trajectories), ("velocities", velocities),
                ) if value is not None
            },
            noise=0.01 if noise is None else noise,
        )  # fmt: skip

        def bound_at(more: int, longer: int) -> Limit:
            changed = {"samples": case.samples * more * longer, "span": case.span * longer}
            return bound(case.model_copy(update=changed), Path())

        note = f"{case.data}: bound at the truth of the system"
    with waiting("taking the bound"):
        found = bound_at(1, 1)
        needed = design(bound_at, target=target)
    content = json.dumps(jsonable(_limit_json(found, needed, note)), indent=2, allow_nan=False) + "\n"
    if json_out == "-":
        print(content, end="")
        return
    show_limit(found, needed, note)
    if json_out is not None:
        write_text(Path(json_out), content)


def _followed(data: Sequence[Samples], candidates: Library, order: int) -> Fit:
    """Fit by the method that gives the motion it follows."""
    from latticebench import methods
    from latticebench.methods.method import solve

    method = next(kind() for kind in methods.registered().values() if kind().abilities.motion)
    with told(data, None, "the fit"):
        return solve(method, data, candidates, order, 1)


def _limit_json(found: Limit, needed: Design, note: str) -> dict[str, Any]:
    rows = zip(found.library.texts, found.coefficients, found.stderr, found.errors, found.verdicts, strict=True)
    return {
        "about": note, "noise": found.noise, "samples": found.samples, "span": found.span,
        "conditioning": found.conditioning, "relative": found.relative,
        "terms": {
            text: {"coefficient": float(value), "stderr": float(stderr), "error": float(error), "verdict": verdict}
            for text, value, stderr, error, verdict in rows
        },
        "groups": [[found.library.texts[k] for k in group] for group in found.groups],
        "needed": dataclasses.asdict(needed),
    }  # fmt: skip
