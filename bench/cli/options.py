"""Options that several commands share, and what the shell completes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import typer

# What options write, and the endings of what they do not.
WRITTEN = {"--json": (".json",), "--html": (".html", ".htm", ".xhtml")}
OTHERS = (
    ".png", ".svg", ".pdf", ".gif", ".mp4", ".jpg", ".jpeg", ".csv", ".md", ".tex", ".json", ".html", ".htm", ".xhtml",
    ".xlsx", ".npz", ".parquet", ".zarr", ".toml", ".py", ".sqlite",
)  # fmt: skip
AnyEnds = Literal["unknown", "free", "fixed", "periodic", "antiperiodic"]
KnownEnds = Literal["free", "fixed", "periodic", "antiperiodic"]


def complete_systems(incomplete: str) -> list[str]:
    """Return the systems whose names begin with `incomplete`."""
    from latticebench import systems

    return [name for name in [*systems.names(), *systems.brought()] if name.startswith(incomplete)]


def complete_methods(incomplete: str) -> list[str]:
    """Return the methods whose names begin with `incomplete`."""
    from latticebench import methods

    return [name for name in [*methods.registered(), *methods.brought()] if name.startswith(incomplete)]


def complete_suites(incomplete: str) -> list[str]:
    """Return the suites whose names begin with `incomplete`."""
    return [path.stem for path in suite_files() if path.stem.startswith(incomplete)]


def complete_libraries(incomplete: str) -> list[str]:
    """Return the libraries of all systems whose names begin with `incomplete`."""
    from latticebench import systems

    found = {library.name for name in systems.names() for library in systems.find(name).libraries}
    return sorted(name for name in found if name.startswith(incomplete))


def complete_recordings(incomplete: str) -> list[str]:
    """Return the recordings whose names begin with `incomplete`."""
    from latticebench.bench.recordings import RECORDINGS

    return [one.name for one in RECORDINGS if one.name.startswith(incomplete)]


def suite_files() -> list[Path]:
    """Return the files of the suites that come with the package, by name."""
    return sorted(Path(__file__).parents[1].glob("suites/*.toml"))


def named(text: str) -> str:
    """Return a name or path that is given.

    Raises:
        typer.BadParameter: it is empty.
    """
    if not text.strip() or "\0" in text:
        raise typer.BadParameter("it is empty; give a name, or leave the option out")
    return text


def place(text: str | Path) -> Path:
    """Return a path that is given; an empty one would be the working folder.

    Raises:
        typer.BadParameter: it is empty.
    """
    return Path(named(str(text)))


def check_places(inputs: Iterable[Path | str | None], **outputs: Path | str | None) -> None:
    """Make sure, before any work, that the outputs of a command can be written and replace none of its inputs.

    Args:
        inputs: files that the command reads, and names of systems and methods that may be files; None for none.
        outputs: by their options; None and "-" (the screen) for none.

    Raises:
        InputError: an output has the ending of another kind of file, or is not as it should be, see
            `latticebench.systems.files.check_outputs`.
    """
    from latticebench.bench.case import code_file
    from latticebench.systems.errors import InputError
    from latticebench.systems.files import check_outputs, shown

    read = [Path(code_file(one) or one if isinstance(one, str) else one) for one in inputs if one is not None]
    given = {f"--{name}": Path(path) for name, path in outputs.items() if path not in (None, "-")}
    check_outputs(given, read)
    for option, path in given.items():
        written = WRITTEN.get(option, ())
        if written and path.suffix.lower() in OTHERS and path.suffix.lower() not in written:
            raise InputError(f"{option} {shown(path)}: it writes {written[0]}; give a name that ends so")


SystemName = Annotated[
    str, typer.Argument(help="A name from `list systems`, or a .py or .toml file.", autocompletion=complete_systems)
]
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="May be given several times.")]
SystemOption = Annotated[
    str | None, typer.Option(help="Take order and libraries from this system.", autocompletion=complete_systems)
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        help="A name from `list methods`, or a .py file with one of your own; trajectory if not given.",
        autocompletion=complete_methods,
        parser=named, metavar="NAME",
    ),
]  # fmt: skip
TimeLimit = Annotated[
    float | None,
    typer.Option(min=1e-3, max=1e9, metavar="S", help="Seconds that a .py method may take; 3600 if not given."),
]
MemoryLimit = Annotated[
    int | None, typer.Option(min=1, max=10**9, metavar="MIB", help="What it may need; 4096 if not given.")
]
Library = Annotated[str | None, typer.Option(help="A library of the system.", autocompletion=complete_libraries)]
Terms = Annotated[str | None, typer.Option(help="Terms of your own, with ; between them.")]
Order = Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")]
Beside = Annotated[
    Path | None,
    typer.Option(
        "--with", metavar="DIR", parser=place,
        help="Put these results of the same cases beside the run's: published tables, such as paper, or a store.",
    ),
]  # fmt: skip
Jobs = Annotated[int | None, typer.Option(min=1, max=1024, help="Worker processes; one per core if not given.")]
Recordings = Annotated[Path, typer.Option(parser=place, metavar="DIR", help="The folder of measured recordings.")]
Only = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PATTERN",
        help="Run only cases whose title, part, system, library, method or effect is so, such as 'phi4*'; may be given "
        "several times.",
    ),
]
Methods = Annotated[
    list[str] | None,
    typer.Option(
        metavar="A,B,MINE.py",
        help="Run these methods instead of the suite's: its labels, names from `list methods`, or .py files.",
        autocompletion=complete_methods,
    ),
]
Seeds = Annotated[str | None, typer.Option(metavar="1-5", help="Run these seeds instead of the suite's; or 1,3,7.")]
Yes = Annotated[bool, typer.Option("--yes", help="Go on, however much time and memory it may take.")]
HtmlOut = Annotated[
    Path | None, typer.Option("--html", metavar="OUT", parser=place, help="Write one HTML file with pictures.")
]
JsonOut = Annotated[
    str | None,
    typer.Option("--json", metavar="OUT", parser=named, help="Write it as JSON to a file, or - for the screen."),
]
