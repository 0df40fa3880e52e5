"""`latticebench simulate`: write samples of a system."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from latticebench.bench.cli.arguments import numbers
from latticebench.bench.cli.options import KnownEnds, Settings, SystemName, Yes, check_places, place
from latticebench.systems.errors import unknown
from latticebench.systems.files import shown

EPILOG = (
    "Example:  latticebench simulate phi4 --set C=2 --set v=0.5 --sites 31 --samples 50 --noise 0.01 --seed 1 "
    "--out phi4.csv"
)


def simulate(
    system: SystemName,
    out: Annotated[
        Path, typer.Option(parser=place, metavar="FILE", help="The file to write: .csv, .npz, .parquet, or .zarr.")
    ],
    given: Settings = None,
    sites: Annotated[int | None, typer.Option(help="Number of sites N.")] = None,
    samples: Annotated[int, typer.Option(help="Number of sample times.")] = 50,
    span: Annotated[float, typer.Option(help="Length of the record; times are 0, span/samples, ...")] = 10.0,
    uneven: Annotated[bool, typer.Option("--uneven", help="Draw the sample times at random.")] = False,
    noise: Annotated[float, typer.Option(help="Noise level: sigma over the RMS of the field about its mean.")] = 0.0,
    missing: Annotated[float, typer.Option(help="Share of the values that are lost.")] = 0.0,
    trajectories: Annotated[
        int, typer.Option(help="Number of trajectories; each further one starts from another state.")
    ] = 1,
    velocities: Annotated[bool, typer.Option(help="Write v1..vN too (second-order systems).")] = True,
    ends: Annotated[KnownEnds | None, typer.Option(help="How the chain ends; the system's own if not given.")] = None,
    initial: Annotated[str | None, typer.Option(help="Initial state; the system's first if not given.")] = None,
    integrator: Annotated[
        Literal["rk4", "bdf", "dop853"] | None,
        typer.Option(help="The system's own (the paper's) if not given; of more than 1000 sites dop853."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, gaps and uneven times.")] = 1,
    parts: Annotated[
        bool, typer.Option("--parts", help="Write a .parquet folder, with a file for each trajectory.")
    ] = False,
    yes: Yes = False,
) -> None:
    """Simulate a system and write samples of it."""
    from latticebench import systems
    from latticebench.bench.calls import case_of
    from latticebench.bench.effort import check_size
    from latticebench.bench.fitting import samples as make_samples
    from latticebench.systems.folders import ZARR
    from latticebench.systems.readers import FORMATS
    from latticebench.systems.simulate import drift
    from latticebench.systems.writers import write

    check_places([system], out=out)
    found = systems.find(system)
    if out.suffix.lower() not in (*FORMATS, ZARR):
        raise unknown("ending", out.suffix, (*FORMATS, ZARR), str(out))
    case = case_of(
        system=system, parameters=numbers(given), sites=sites, samples=samples, span=span, uneven=uneven, noise=noise,
        missing=missing, trajectories=trajectories, velocities=velocities, ends=ends, initial=initial,
        integrator=integrator, seed=seed,
    )  # fmt: skip
    if not yes:
        check_size(case, case.sites or found.sites, system)
    data = make_samples(case, Path())
    write([one.observed() for one in data], out, parts=parts)
    listed = ", ".join(f"{name}={value:g}" for name, value in found.with_parameters(case.parameters).items())
    drifts = [drift(found, case.parameters, one.exact, case.ends) for one in data if one.exact is not None]
    kept = [one for one in drifts if one is not None]
    print(
        f"{shown(out)}: {found.name} ({listed}), {data[0].sites} sites, {len(data[0].t)} samples x {len(data)} "
        f"trajectories, noise {noise:g}{f'; what it conserves drifts by {max(kept):.1e}' if kept else ''}"
    )
