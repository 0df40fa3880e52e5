"""`latticebench compare`: judge one run by another, or methods by one of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.arguments import kept
from latticebench.bench.cli.options import Beside, check_places, place
from latticebench.systems.errors import InputError, printable, unknown
from latticebench.systems.files import shown

if TYPE_CHECKING:
    from latticebench.bench.against import Contest

# Cases that only one of two runs has, of which so many are named.
LISTED = 20

EPILOG = (
    "Example:  latticebench compare results/default runs/default\n\n"
    "Methods:  latticebench compare runs/mine --with results/paper --against stlsq --out ranks.pdf"
)
TABLES = (".csv", ".md", ".tex")


def compare(
    old: Annotated[Path, typer.Argument(parser=place, help="A store, a folder of published tables, or one table.")],
    new: Annotated[
        Path | None, typer.Argument(parser=place, help="The same, to be judged; none with --against.")
    ] = None,
    factor: Annotated[float, typer.Option(min=1.0, help="An error that grew beyond this factor is a loss.")] = 2.0,
    reference: Annotated[
        str | None, typer.Option("--against", metavar="METHOD", help="Compare the methods of one run with this one.")
    ] = None,
    beside: Beside = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=place, metavar="OUT",
            help="With --against: mean ranks as .png, .svg or .pdf, wins and losses as .csv, .md or .tex; or a folder "
            "for all of them, with one row per case and method.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:  # fmt: skip
    """Compare two runs case by case, and each method by a paired test; exit code 1 when any case is a loss.

    With --against, compare the methods of one run with one of them.
    """
    if reference is not None:
        if new is not None:
            raise InputError(f"--against: give one run, and others of the same cases with --with {new}")
        _compare_methods(old, reference, beside, out, as_json)
        return
    if new is None:
        raise InputError(f"compare {old} with what? Give a second run, or a method of this one with --against METHOD")
    if beside is not None or out is not None:
        raise InputError("--with and --out go with --against METHOD; two runs are compared without them")
    _compare_runs(old, new, factor, as_json)


def _compare_runs(old: Path, new: Path, factor: float, as_json: bool) -> None:
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
        for word, names in (("gone", found.gone), ("new", found.fresh)):
            for name in names[:LISTED]:
                print(printable(f"{word}: {name}"))
            if len(names) > LISTED:
                print(f"{word}: {len(names) - LISTED} more cases")
        for _, row in found.methods.iterrows():
            told = f"{row['pairs']} pairs, median ratio {row['ratio']:.3g}, p = {row['p']:.2g}"
            print(printable(f"{row['verdict']}: {row['method']} ({told})"))
        counts = f"{len(found.worse)} losses, {len(found.better)} gains, {found.same} the same"
        print(f"{counts} (within a factor of {factor:g})")
    if len(found.worse):
        raise typer.Exit(1)


def _compare_methods(run: Path, reference: str, beside: Path | None, out: Path | None, as_json: bool) -> None:
    """Print and write how methods do against one of them.

    Raises:
        InputError: there is no such method, or nothing that could be written to such a file.
    """
    from latticebench.bench.against import against
    from latticebench.bench.beside import read_published
    from latticebench.bench.figures import IMAGES
    from latticebench.bench.provenance import command_line, commit
    from latticebench.bench.tables import file_of_cases, read_cases

    if out is not None and out.suffix.lower() not in (*IMAGES, *TABLES, ""):
        raise unknown("ending", out.suffix, (*IMAGES, *TABLES), f"--out {out}")
    table = read_cases(run)
    about = {"command": command_line(), "commit": commit()}
    read = [file_of_cases(run)]
    if beside is not None:
        published = read_published(beside)
        table = published.joined(table)
        about["published"] = published.about
        read.append(published.file)
    found = against(table, reference)
    files = () if out is None else _files(found, out)
    for path in files:
        check_places(read, out=path)
    written: list[Path] = []
    failures: list[str] = []
    # Files first: the screen may be full, or its reader stop reading.
    for path in files:
        with kept(failures):
            written.append(_write(found, path, about))
    if as_json:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import against_document

        print(to_json(against_document(found, provenance(), about.get("published", ""))), end="")
    else:
        _show(found)
    for path in written:
        print(shown(path), file=sys.stderr if as_json else sys.stdout)
    if failures:
        raise InputError("; ".join(failures))


def _show(found: Contest) -> None:
    from latticebench.bench.paired import LEVEL, least_p
    from latticebench.bench.publish import readable
    from latticebench.bench.report.screen import show_note, show_rows

    rows = readable(found.methods)
    show_rows(list(rows.columns), rows.to_numpy().tolist(), keys=1)
    show_note("per case: E2 smaller, larger, not told apart; ratio of E2, median over the cases with its 95 % interval")
    show_note(f"p: signed-rank test over the cases, corrected for {len(found.methods)} methods (Holm)")
    for cases in sorted(found.methods["cases"].unique()):
        if least_p(cases) > LEVEL:
            show_note(f"{cases} cases cannot tell two methods apart: p is {least_p(cases):.2g} at the least")
    if found.ranks is None:
        show_note("no mean ranks: they need three methods and two cases that all of them have")
        return
    ranks = found.ranks
    show_rows(["method", "mean rank"], [[name, f"{rank:.2f}"] for name, rank in ranks.mean.items()])
    left_out = f"; left out, with too few of them: {', '.join(ranks.left_out)}" if ranks.left_out else ""
    show_note(
        f"mean rank of E2 over {ranks.cases} cases, p = {ranks.p:.2g} (Friedman); those that differ by less than "
        f"{ranks.distance:.2f} are not told apart (Nemenyi){left_out}"
    )


def _files(found: Contest, out: Path) -> list[Path]:
    """Return what is written: mean ranks as a figure, wins and losses as a table, or into a folder all that there is.

    Raises:
        InputError: there are no mean ranks for the figure.
    """
    if found.ranks is None and out.suffix.lower() not in (*TABLES, ""):
        raise InputError(f"--out {shown(out)}: there are no mean ranks to draw; they need three methods and two cases")
    if out.suffix:
        return [out]
    tables = [out / f"{name}{form}" for name in ("against", "against-cases") for form in TABLES]
    return tables if found.ranks is None else [*tables, out / "ranks.png"]


def _write(found: Contest, path: Path, about: dict[str, Any]) -> Path:
    """Write mean ranks into a figure, or wins and losses into a table.

    Raises:
        InputError: the file cannot be written.
    """
    from latticebench.bench.figures import save
    from latticebench.bench.publish import render
    from latticebench.bench.ranking import draw_ranks
    from latticebench.systems.files import write_text

    if path.suffix.lower() not in TABLES:
        assert found.ranks is not None
        return save(draw_ranks(found.ranks), path, about)
    frame = found.cases if path.stem == "against-cases" else found.methods
    write_text(path, render(frame, about, path.suffix.lower()[1:], path.stem))
    return path
