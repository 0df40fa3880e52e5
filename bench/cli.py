"""The command line: `latticebench list|simulate|fit|diagnose|data|run|table|figures|compare|limit`.

Everything heavy is imported where it is used, so that `--help`, `list` and tab completion answer at once.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from latticebench.systems.errors import InputError, unknown

if TYPE_CHECKING:
    from latticebench.bench.limit import Design, Limit
    from latticebench.bench.suite import Case, Suite
    from latticebench.methods.method import Fit
    from latticebench.systems.lattice import Library, System
    from latticebench.systems.samples import Samples

app = typer.Typer(
    name="latticebench",
    help="Find the equations of motion of nonlinear lattices from data, and measure how well each method does it.",
    epilog="Start with:  latticebench run tiny    or    latticebench list systems",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

Kind = Literal["systems", "libraries", "methods", "suites", "effects"]
AnyEnds = Literal["unknown", "free", "fixed", "periodic", "antiperiodic"]
KnownEnds = Literal["free", "fixed", "periodic", "antiperiodic"]
# The library of a system that has the terms of its own equation.
EQUATION = "equation"


def main() -> None:
    """Run the command line; bad input is one line on standard error and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except InputError as error:
        _complain(str(error))
        code = 2
    except typer.Abort:
        code = 130
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:
        # The reader (head, a pager) has seen enough; Python would complain once more on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except Exception as error:
        # Usage errors of the command-line library; anything else is a fault of ours and keeps its traceback.
        message: Callable[[], str] | None = getattr(error, "format_message", None)
        if message is None:
            raise
        text = message().strip().splitlines()
        if text:
            _complain(f"{' '.join(text)} (see: latticebench --help)")
        code = 2
    sys.exit(code if isinstance(code, int) else 0)


def _complain(text: str) -> None:
    print("error: " + " ".join(text.splitlines()), file=sys.stderr)


# What the shell completes --------------------------------------------------------------------------------------------------


def _systems(incomplete: str) -> list[str]:
    from latticebench import systems

    return [name for name in systems.names() if name.startswith(incomplete)]


def _methods(incomplete: str) -> list[str]:
    from latticebench import methods

    return [name for name in methods.registered() if name.startswith(incomplete)]


def _suites(incomplete: str) -> list[str]:
    return [path.stem for path in _suite_files() if path.stem.startswith(incomplete)]


def _libraries(incomplete: str) -> list[str]:
    from latticebench import systems

    found = {library.name for name in systems.names() for library in systems.find(name).libraries}
    return sorted(name for name in found if name.startswith(incomplete))


def _recordings(incomplete: str) -> list[str]:
    from latticebench.bench.recordings import RECORDINGS

    return [one.name for one in RECORDINGS if one.name.startswith(incomplete)]


def _suite_files() -> list[Path]:
    here = Path(__file__).parent
    return sorted((*here.glob("suites/*.toml"), *here.glob("trials/suites/*.toml")), key=lambda path: path.stem)


SystemName = Annotated[
    str, typer.Argument(help="A name from `list systems`, or a .py or .toml file.", autocompletion=_systems)
]
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="May be given several times.")]


# Commands ------------------------------------------------------------------------------------------------------------------


@app.command("list", epilog="Example:  latticebench list libraries --json")
def list_(
    kind: Annotated[Kind, typer.Argument(help="What to list.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """Say what there is."""
    from latticebench.bench.screen import show_rows

    makers = {
        "systems": _system_rows, "libraries": _library_rows, "methods": _method_rows, "suites": _suite_rows,
        "effects": _effect_rows,
    }  # fmt: skip
    rows = makers[kind]()
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    show_rows(list(rows[0]), [list(row.values()) for row in rows])


def _system_rows() -> list[dict[str, Any]]:
    from latticebench import systems

    rows = []
    for name in systems.names():
        system = systems.find(name)
        rows.append(
            {
                "name": name, "equation": f"u{chr(39) * system.order} = {system.equation}",
                "field": "complex" if system.is_complex else "real", "parameters": dict(system.parameters),
                "initial states": list(system.initials), "ends": system.ends, "sites": system.sites, "source": system.source,
            }
        )  # fmt: skip
    return rows


def _library_rows() -> list[dict[str, Any]]:
    from latticebench import systems

    return [
        {
            "system": name,
            "library": library.name,
            "size": len(library.terms),
            "terms": list(library.texts),
            "source": library.source,
        }
        for name in systems.names()
        for library in systems.find(name).libraries
    ]


def _method_rows() -> list[dict[str, Any]]:
    from latticebench import methods
    from latticebench.methods.method import settings

    return [
        {"name": name, "what it is": (kind.__doc__ or "").strip().splitlines()[0], "settings": settings(kind)}
        for name, kind in methods.registered().items()
    ]


def _effect_rows() -> list[dict[str, Any]]:
    from latticebench.systems.effects import CATALOGUE, HOW

    return [
        {
            "name": one.name, "second order, real": next(iter(one.texts(2, False)), ""),
            "first order, complex": next(iter(one.texts(1, True)), ""), "how it acts": HOW[one.acts],
            "what gives it away": one.look_for, "source": one.source,
        }
        for one in CATALOGUE
    ]  # fmt: skip


def _suite_rows() -> list[dict[str, Any]]:
    from latticebench.systems.toml import read_toml

    return [{"name": path.stem, "what it is for": read_toml(path).get("title", "")} for path in _suite_files()]


@app.command(
    epilog="Example:  latticebench simulate phi4 --set C=2 --set v=0.5 --sites 31 --samples 50 --noise 0.01 --seed 1 --out phi4.csv"
)
def simulate(
    system: SystemName,
    out: Annotated[Path, typer.Option(help="The file to write: .csv, .npz or .parquet.")],
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
        Literal["rk4", "bdf", "dop853"] | None, typer.Option(help="The system's own (the paper's) if not given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise, gaps and uneven times.")] = 1,
) -> None:
    """Simulate a system and write samples of it."""
    from latticebench import systems
    from latticebench.bench.case import samples as make_samples
    from latticebench.systems.samples import FORMATS, write

    found = systems.find(system)
    if out.suffix.lower() not in FORMATS:
        raise unknown("ending", out.suffix, FORMATS, str(out))
    case = _case(
        system=system, parameters=_numbers(given), sites=sites, samples=samples, span=span, uneven=uneven, noise=noise,
        missing=missing, trajectories=trajectories, velocities=velocities, ends=ends, initial=initial,
        integrator=integrator, seed=seed,
    )  # fmt: skip
    data = make_samples(case, Path())
    write([one.observed() for one in data], out)
    listed = ", ".join(f"{name}={value:g}" for name, value in found.with_parameters(case.parameters).items())
    print(
        f"{out}: {found.name} ({listed}), {data[0].sites} sites, {len(data[0].t)} samples x {len(data)} trajectories, noise {noise:g}"
    )


@app.command(
    epilog='Examples:  latticebench fit phi4.csv --system phi4 --library lib2 --method stlsq --set threshold=0.1\n\n'
    '           latticebench fit my.csv --terms "u\\[n+1]; u\\[n-1]; u\\[n]; u\\[n]**3" --order 2 --method least-squares'
)  # fmt: skip
def fit(
    files: Annotated[list[Path], typer.Argument(help="One or more .csv, .npz or .parquet files.")],
    system: Annotated[
        str | None, typer.Option(help="Take order and libraries from this system.", autocompletion=_systems)
    ] = None,
    library: Annotated[str | None, typer.Option(help="A library of the system.", autocompletion=_libraries)] = None,
    terms: Annotated[str | None, typer.Option(help="Terms of your own, with ; between them.")] = None,
    order: Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")] = None,
    method: Annotated[
        str | None, typer.Option(help="A name from `list methods`, or a .py file.", autocompletion=_methods)
    ] = None,
    given: Settings = None,
    ends: Annotated[
        AnyEnds, typer.Option(help="How the chain ends; unknown uses only sites whose whole stencil was seen.")
    ] = "unknown",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the method's own draws.")] = 1,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="OUT", help="Write the fit as JSON to a file, or - for the screen.")
    ] = None,
) -> None:
    """Fit the coefficients of a library to recorded samples."""
    from latticebench import methods
    from latticebench.bench.screen import show_fit, waiting
    from latticebench.methods.method import make, solve
    from latticebench.systems.files import write_text
    from latticebench.systems.samples import read_all

    method = method or methods.DEFAULT
    chosen = make(methods.find(method), _texts(given))
    _, candidates, order = _asked(system, library, terms, order)
    data = read_all(files, ends)
    with (
        _told(data, method, f"method {method!r}"),
        waiting(f"{method}: fitting {len(candidates.terms)} terms"),
        redirect_stdout(sys.stderr),
    ):
        found = solve(chosen, data, candidates, order, seed)
    content = json.dumps(_fit_json(found), indent=2, allow_nan=False) + "\n"
    if json_out == "-":
        print(content, end="")
        return
    show_fit(found)
    if json_out is not None:
        write_text(Path(json_out), content)


@app.command(
    epilog="Examples:  latticebench diagnose phi4.csv --system phi4 --html diagnosis.html\n\n"
    '           latticebench diagnose my.csv --terms "u\\[n+1]+u\\[n-1]-2*u\\[n]; sin(u\\[n])" --order 2 --holdout later.csv'
)
def diagnose(
    files: Annotated[list[Path], typer.Argument(help="One or more .csv, .npz or .parquet files.")],
    system: Annotated[
        str | None,
        typer.Option(help="Declare this system's equation, its coefficients free.", autocompletion=_systems),
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="Declare an equation of your own: its terms, with ; between them.")
    ] = None,
    order: Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")] = None,
    ends: Annotated[
        AnyEnds | None,
        typer.Option(help="How the chain ends: the system's own, with --terms unknown, if not given."),
    ] = None,
    effects: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A .toml file with effects of your own, tried beside the catalogue."),
    ] = None,
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Judge forecasts on this file, not on the last 30 % of the record; may be given several times.",
        ),
    ] = None,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="OUT", help="Write it as JSON to a file, or - for the screen.")
    ] = None,
    html_out: Annotated[
        Path | None, typer.Option("--html", metavar="OUT", help="Write one HTML file with pictures.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="Take the declared equation's first coefficients from this method's fit (of `list methods`); whole trajectories otherwise.",
            autocompletion=_methods,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated noise that evidence is judged by.")] = 1,
) -> None:
    """Say what a declared equation lacks: find the residual, trace it to an effect, add that, and show the error before and after."""
    from latticebench import methods
    from latticebench.bench.report.report import content, show, watching
    from latticebench.diagnosis.repair import diagnose as close_the_loop
    from latticebench.methods.method import make, solve
    from latticebench.systems.effects import CATALOGUE, load
    from latticebench.systems.files import write_text
    from latticebench.systems.samples import read_all

    if system is not None and (terms is not None or order is not None):
        raise InputError(
            "--system declares an equation and its order: give it alone, or --terms and --order without it"
        )
    if system is None and terms is None:
        raise InputError(
            'give --system, or --terms and --order, such as --terms "u[n+1]+u[n-1]-2*u[n]; sin(u[n])" --order 2'
        )
    known, declared, order = _declared(system, terms, order)
    catalogue = (*CATALOGUE, *(load(effects) if effects is not None else ()))
    ends = ends or ("unknown" if known is None else known.ends)
    data = read_all(files, ends)
    if known is not None and known.is_complex != data[0].is_complex:
        kinds = ("real", "complex")
        raise InputError(
            f"{data[0].source}: the field is {kinds[data[0].is_complex]}, that of {known.name} is {kinds[known.is_complex]}; "
            "choose another --system, or give --terms"
        )
    # Read together, since the two must be of the same chain.
    later = read_all([*files, *holdout], ends)[len(data) :] if holdout else []
    with _told(data, method, "the diagnosis"), watching() as watcher, redirect_stdout(sys.stderr):
        start = (
            None if method is None else solve(make(methods.find(method), {}), data, declared, order, seed).coefficients
        )
        found = close_the_loop(declared, order, data, catalogue, seed, held_out=later, watcher=watcher, start=start)
    text = json.dumps(content(found), indent=2, allow_nan=False) + "\n"
    # Files first: whoever reads the screen may stop reading.
    if html_out is not None:
        from latticebench.bench.provenance import command_line, origin
        from latticebench.bench.report.page import write_page

        write_page(found, {"command": " ".join(["latticebench", *command_line()]), "seed": seed, **origin()}, html_out)
    if json_out == "-":
        print(text, end="")
        return
    if json_out is not None:
        write_text(Path(json_out), text)
    show(found)


def _declared(system: str | None, terms: str | None, order: int | None) -> tuple[System | None, Library, int]:
    """Make out which equation is declared: the system's own terms, or those given."""
    if system is not None:
        from latticebench import systems

        if EQUATION not in [one.name for one in systems.find(system).libraries]:
            raise InputError(
                f"--system {system}: it has no library {EQUATION!r} that says which coefficients are free; give it one, or give --terms"
            )
    return _asked(system, EQUATION if terms is None else None, terms, order)


data_app = typer.Typer(
    help="List measured recordings, and take a local copy of one.",
    epilog="Example:  latticebench data take gliders ~/Downloads/gliders.csv",
    invoke_without_command=True,
    rich_markup_mode="rich",
)
app.add_typer(data_app, name="data")


@data_app.callback()
def data(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """List measured recordings, and take a local copy of one."""
    if context.invoked_subcommand is not None:
        return
    from latticebench.bench.recordings import RECORDINGS

    rows = [dataclasses.asdict(one) for one in RECORDINGS]
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    for one in RECORDINGS:
        print(f"{one.name}: {one.what}")
        print(f"    {one.rows} rows of {one.columns}, {one.sampling}\n    source:  {one.source}")
        print(f"    licence: {one.licence}\n    SHA-256: {one.sha256}\n")
    print("None of them comes with this program. Have one already?  latticebench data take NAME FILE")


@data_app.command(epilog="Example:  latticebench data take gliders ~/Downloads/gliders.csv data")
def take(
    name: Annotated[str, typer.Argument(help="A recording that `data` lists.", autocompletion=_recordings)],
    origin: Annotated[Path, typer.Argument(metavar="FILE", help="The file that you have of it.")],
    place: Annotated[
        Path | None, typer.Argument(metavar="[TO]", help="A folder or a .csv file for the copy; data/ if not given.")
    ] = None,
) -> None:
    """Check that a file is a recording, by its SHA-256, and copy it to where you want it. Nothing is downloaded."""
    from latticebench.bench.recordings import take as copy

    made, new = copy(name, origin, place)
    print(f"{made}: {'copied' if new else 'was there already'}, SHA-256 as it should be")


def _asked(
    system: str | None, library: str | None, terms: str | None, order: int | None
) -> tuple[System | None, Library, int]:
    """Make out which library and order --system, --library, --terms and --order ask for."""
    from latticebench import systems
    from latticebench.systems.lattice import library as make_library

    known = None if system is None else systems.find(system)
    if terms is not None and library is not None:
        raise InputError("--terms and --library: give one of them")
    if terms is not None:
        candidates = make_library("terms", terms)
    elif known is not None:
        if library is None:
            raise InputError(
                f"--library: choose one of {', '.join(one.name for one in known.libraries)}, or give --terms"
            )
        candidates = known.library(library)
    else:
        raise InputError(
            'give --system and --library, or --terms and --order, such as --terms "u[n+1]; u[n-1]; u[n]" --order 2'
        )
    if order is None:
        if known is None:
            raise InputError("--order: 1 for du/dt, 2 for the second derivative")
        order = known.order
    return known, candidates, order


def _case(**given: Any) -> Case:
    """Check what describes simulated samples."""
    import pydantic

    from latticebench.bench.suite import Case

    try:
        return Case(**{"library": "", "label": "", "method": "", **given})
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"--{first['loc'][0]}: {first['msg'].lower()}, it is {first['input']!r}") from None


def _fit_json(found: Fit) -> dict[str, Any]:
    texts = found.library.texts

    def number(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {
        "method": found.method, "order": found.order,
        "coefficients": {text: number(value) for text, value in zip(texts, found.coefficients, strict=True)},
        "stderr": None if found.stderr is None
        else {text: number(value) for text, value in zip(texts, found.stderr, strict=True)},
        "residual": number(found.residual), "seconds": number(found.seconds), "status": found.status,
    }  # fmt: skip


@app.command(epilog="Example:  latticebench run default --jobs 2 --results runs/default")
def run(
    suite: Annotated[str, typer.Argument(help="A name from `list suites`, or a .toml file.", autocompletion=_suites)],
    jobs: Annotated[int | None, typer.Option(min=1, help="Worker processes; one a core if not given.")] = None,
    results: Annotated[Path | None, typer.Option(help="Where results are kept; runs/SUITE if not given.")] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run cases that failed again.")] = False,
    data: Annotated[Path, typer.Option(help="The folder of measured recordings, for a suite of them.")] = Path("data"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the table of cases as JSON.")] = False,
) -> None:
    """Run a suite, continuing where it was stopped, and show its table of errors."""
    from latticebench.bench.trials.trial import is_suite

    if is_suite(suite):
        _run_trials(suite, jobs or os.cpu_count() or 1, results, data, as_json)
        return
    from latticebench.bench.provenance import command_line, describe
    from latticebench.bench.run import run as run_suite
    from latticebench.bench.screen import progress_bar, show_results
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    loaded = load(suite)
    folder = results if results is not None else Path("runs") / loaded.name
    store = create(folder)
    jobs = jobs or os.cpu_count() or 1
    about = {
        "command": " ".join(["latticebench", *command_line()]), "suite": loaded.name, "jobs": jobs,
        "settings": _contestants(loaded),
    }  # fmt: skip
    # A cluster that ends a job says so first; that is the same as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with progress_bar(len(loaded.cases)) as watcher:
            found, tally = run_suite(loaded, store, jobs=jobs, retry=retry, watcher=watcher, about=about)
    except KeyboardInterrupt:
        print(
            f"stopped; {len(store.all())} results are in {folder}; the same command continues from there",
            file=sys.stderr,
        )
        raise
    if as_json:
        print(_cases_json(found))
        return
    show_results(found, describe(found, store.about()), loaded.title)
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(tally.statuses.items()))
    print(f"{len(found)} cases ({statuses}); {tally.ran} run now, {tally.reused} were there; kept in {folder}")


def _run_trials(suite: str, jobs: int, results: Path | None, data: Path, as_json: bool) -> None:
    """Run a suite of diagnoses, and show how often they were right."""
    from latticebench.bench.provenance import command_line
    from latticebench.bench.screen import progress
    from latticebench.bench.trials.trial import load, run
    from latticebench.systems.files import write_text

    _, trials = load(suite)
    folder = results if results is not None else Path("runs") / Path(suite).stem
    about = {"command": " ".join(["latticebench", *command_line()]), "suite": Path(suite).stem, "jobs": jobs}
    # First, so that a run that is stopped says what it was.
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "about.txt", json.dumps(about) + "\n")
    with progress(len(trials)) as step:
        rows = run(trials, folder, jobs=jobs, data=data, watcher=step)
    _show_trials(folder, None, as_json)
    print(f"{len(rows)} diagnoses, kept in {folder}", file=sys.stderr)


def _show_trials(folder: Path, out: Path | None, as_json: bool) -> None:
    """Show the results of a suite of diagnoses, and publish them."""
    from latticebench.bench.screen import show_rows
    from latticebench.bench.trials import scores

    rows = scores.read(folder)
    if as_json:
        print(json.dumps(rows, indent=2))
    for path in scores.publish(rows, scores.about(rows, folder), out) if out is not None else ():
        print(path, file=sys.stderr if as_json else sys.stdout)
    if as_json or out is not None:
        return
    made = [row for row in rows if "effect" in row]
    if made:
        frame = scores.summary(scores.table(made))
        show_rows(list(frame.columns), frame.to_numpy().tolist())
    for row in rows:
        if "terms" in row:
            found = row["report"]["verdict"] if row["status"] == "ok" else row["message"]
            print(f"{row['name']}: {found}")


@app.command(epilog="Example:  latticebench table runs/default --out results/default")
def table(
    folder: Annotated[Path, typer.Argument(help="A store of results.", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Publish the tables here, as CSV, Markdown and LaTeX.")] = None,
    value: Annotated[str, typer.Option(help="Which score to show.")] = "e2",
    only: Annotated[
        list[str] | None, typer.Option(help="Publish this table alone; may be given several times.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the table of cases as JSON.")] = False,
) -> None:
    """Show the results of a run as a table, and publish them."""
    from latticebench.bench.provenance import describe
    from latticebench.bench.screen import show_results
    from latticebench.bench.store import open_store
    from latticebench.bench.tables import SCORES, TABLES, publish
    from latticebench.bench.trials import scores

    if value not in SCORES:
        raise unknown("score", value, SCORES, "--value")
    chosen = _some(only, TABLES, "table")
    if scores.is_run(folder):
        _show_trials(folder, out, as_json)
        return
    store = open_store(folder)
    found = store.all()
    if not found:
        raise InputError(f"{folder}: there are no results in it yet; run a suite with --results {folder}")
    if as_json:
        print(_cases_json(found))
    else:
        show_results(found, describe(found, store.about()), "", value)
    if out is not None:
        for path in publish(found, describe(found, store.about()), out, chosen):
            print(path, file=sys.stderr if as_json else sys.stdout)


@app.command(epilog="Example:  latticebench figures runs/default --out results/default")
def figures(
    folder: Annotated[Path, typer.Argument(help="A store of results.", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Where to write them; DIR/figures if not given.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Draw this kind of figure alone; may be given several times.")
    ] = None,
) -> None:
    """Draw the results of a run: coefficients against iteration, errors, error against time and noise."""
    from latticebench.bench.figures import FIGURES, draw_all
    from latticebench.bench.provenance import describe
    from latticebench.bench.store import open_store

    chosen = _some(only, FIGURES, "figure")
    store = open_store(folder)
    found = store.all()
    if not found:
        raise InputError(f"{folder}: there are no results in it yet; run a suite with --results {folder}")
    for path in draw_all(found, describe(found, store.about()), out if out is not None else folder / "figures", chosen):
        print(path)


@app.command(epilog="Example:  latticebench compare results/default runs/default")
def compare(
    old: Annotated[Path, typer.Argument(help="A store, a folder with cases.csv, or a cases.csv.")],
    new: Annotated[Path, typer.Argument(help="The same, to be judged.")],
    factor: Annotated[float, typer.Option(min=1.0, help="An error that grew beyond this factor is a loss.")] = 2.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """Say which cases got better or worse; exit code 1 when any got worse."""
    from latticebench.bench.compare import compare as compare_tables
    from latticebench.bench.tables import read_cases

    found = compare_tables(read_cases(old), read_cases(new), factor)
    if as_json:
        rows = {"worse": found.worse.to_dict("records"), "better": found.better.to_dict("records")}
        rest = {"same": found.same, "gone": found.gone, "new": found.fresh}
        print(json.dumps({**_jsonable(rows), **rest}, indent=2))
    else:
        for name, frame in (("worse", found.worse), ("better", found.better)):
            for _, row in frame.iterrows():
                print(f"{name}: {row['case']}: E2 {row['old']} -> {row['new']}")
        for name in found.gone:
            print(f"gone: {name}")
        for name in found.fresh:
            print(f"new: {name}")
        print(
            f"{len(found.worse)} worse, {len(found.better)} better, {found.same} the same (within a factor of {factor:g})"
        )
    if len(found.worse):
        raise typer.Exit(1)


@app.command(
    epilog="Examples:  latticebench limit --system phi4 --set C=2 --library lib4 --noise 0.01\n\n"
    "           latticebench limit phi4.csv --system phi4 --library lib2 --ends free"
)
def limit(
    files: Annotated[
        list[Path] | None, typer.Argument(help="Recorded samples; without any, samples of --system are taken.")
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(help="What moves; with files, where order and libraries come from.", autocompletion=_systems),
    ] = None,
    library: Annotated[str | None, typer.Option(help="A library of the system.", autocompletion=_libraries)] = None,
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

    known, candidates, order = _asked(system, library, terms, order)
    only_simulated = {
        "--set": given, "--sites": sites, "--samples": samples, "--span": span, "--noise": noise,
        "--trajectories": trajectories, "--velocities": velocities, "--initial": initial,
    }  # fmt: skip
    if files:
        for name, value in only_simulated.items():
            if value is not None:
                raise InputError(f"{name}: files are given, whose samples are as they are; leave it out, or the files")
        from latticebench.systems.samples import read_all

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
        from latticebench.bench.case import bound

        case = _case(
            system=system, parameters=_numbers(given), sites=sites, initial=initial, library=candidates.name,
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
    content = json.dumps(_jsonable(_limit_json(found, needed, note)), indent=2, allow_nan=False) + "\n"
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
    with _told(data, None, "the fit"):
        return solve(method, data, candidates, order, 1)


@contextmanager
def _told(data: Sequence[Samples], method: str | None, what: str) -> Iterator[None]:
    """Say in one line why nothing came of a fit.

    Raises:
        InputError: it was skipped, or it failed.
    """
    from latticebench.methods.method import Skipped

    try:
        yield
    except Skipped as reason:
        if method is None:
            raise InputError(f"{data[0].source}: {reason}") from None
        raise InputError(
            f"method {method!r} cannot fit {data[0].source}: {reason}; choose another with --method"
        ) from None
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{data[0].source}: {what} failed: {type(error).__name__}: {error}") from error


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


# Words and numbers ---------------------------------------------------------------------------------------------------------


def _texts(given: Sequence[str] | None) -> dict[str, str]:
    """Read NAME=VALUE pairs."""
    pairs = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise InputError(f"--set {text!r}: write NAME=VALUE, such as --set threshold=0.1")
        pairs[name.strip()] = value.strip()
    return pairs


def _some(only: Sequence[str] | None, names: Sequence[str], kind: str) -> Sequence[str]:
    """Take all names, or those that --only gives."""
    for name in only or ():
        if name not in names:
            raise unknown(kind, name, names, "--only")
    return only or names


def _numbers(given: Sequence[str] | None) -> dict[str, float]:
    numbers = {}
    for name, value in _texts(given).items():
        try:
            numbers[name] = float(value)
        except ValueError:
            numbers[name] = math.nan
        if not math.isfinite(numbers[name]):
            raise InputError(f"--set {name}={value}: {value!r} is not a number")
    return numbers


def _jsonable(value: Any) -> Any:
    """Put None for NaN and texts for infinities, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _jsonable(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def _cases_json(results: Sequence[Mapping[str, Any]]) -> str:
    from latticebench.bench.tables import cases

    return json.dumps(_jsonable(cases(results).to_dict("records")), indent=2)


def _contestants(suite: Suite) -> dict[str, str]:
    """Say what each label of a suite stands for, with all its settings."""
    from latticebench import methods
    from latticebench.methods.method import make, settings

    written = {}
    for case in suite.cases:
        if case.label not in written:
            kind = methods.find(case.method, suite.base)
            chosen = make(kind, case.settings)
            values = {name: getattr(chosen, name) for name in settings(kind)}
            written[case.label] = ", ".join([case.method, *(f"{n}={v}" for n, v in values.items() if v is not None)])
    return written


if __name__ == "__main__":
    main()
