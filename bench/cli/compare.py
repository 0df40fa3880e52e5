"""`latticebench compare`: judge one run by another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.systems.errors import printable

EPILOG = "Example:  latticebench compare results/default runs/default"


def compare(
    old: Annotated[Path, typer.Argument(help="A store, a folder of published tables, or one table.")],
    new: Annotated[Path, typer.Argument(help="The same, to be judged.")],
    factor: Annotated[float, typer.Option(min=1.0, help="An error that grew beyond this factor is a loss.")] = 2.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """Compare two runs case by case, and each method by a paired test; exit code 1 when any case is a loss."""
    from latticebench.bench.compare import compare as compare_runs
    from latticebench.bench.compare import read_run

    found = compare_runs(read_run(old), read_run(new), factor)
    if as_json:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import compare_document

        print(to_json(compare_document(found, provenance())), end="")
    else:
        for name, frame in (("loss", found.worse), ("gain", found.better)):
            for _, row in frame.iterrows():
                print(printable(f"{name}: {row['case']}: {row['old']} -> {row['new']}"))
        for name in found.gone:
            print(printable(f"gone: {name}"))
        for name in found.fresh:
            print(printable(f"new: {name}"))
        for _, row in found.methods.iterrows():
            told = f"{row['pairs']} pairs, median ratio {row['ratio']:.3g}, p = {row['p']:.2g}"
            print(printable(f"{row['verdict']}: {row['method']} ({told})"))
        counts = f"{len(found.worse)} losses, {len(found.better)} gains, {found.same} the same"
        print(f"{counts} (within a factor of {factor:g})")
    if len(found.worse):
        raise typer.Exit(1)
