"""`latticebench list`: name what there is."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated, Any, Literal

import typer

from latticebench.bench.cli.options import suite_files
from latticebench.systems.errors import InputError

Kind = Literal["systems", "libraries", "methods", "suites", "effects"]

EPILOG = "Example:  latticebench list libraries --json"


def list_(
    kind: Annotated[Kind, typer.Argument(help="What to list.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """List what there is."""
    from latticebench.bench.report.screen import show_rows

    makers = {
        "systems": _system_rows, "libraries": _library_rows, "methods": _method_rows, "suites": _suite_rows,
        "effects": _effect_rows,
    }  # fmt: skip
    rows = makers[kind]()
    if as_json:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import ListDocument

        print(to_json(ListDocument(provenance=provenance(), kind=kind, rows=rows)), end="")
        return
    show_rows(list(rows[0]), [list(row.values()) for row in rows])


def _system_rows() -> list[dict[str, Any]]:
    from latticebench import systems
    from latticebench.systems import packages

    rows: list[dict[str, Any]] = []
    for name in [*systems.names(), *systems.brought()]:
        try:
            system = systems.find(name)
        except InputError as error:
            rows.append({**dict.fromkeys(rows[0], ""), "name": name, "source": str(error)})
            continue
        rows.append(
            {
                "name": name, "equation": f"u{chr(39) * system.order} = {system.equation}",
                "field": "complex" if system.is_complex else "real", "parameters": dict(system.parameters),
                "initial states": list(system.initials), "ends": system.ends, "sites": system.sites,
                "source": system.source,
            }
        )  # fmt: skip
    taken = packages.hidden(packages.SYSTEMS, systems.names())
    return [*rows, *({**dict.fromkeys(rows[0], ""), "name": name, "source": why} for name, why in taken.items())]


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
        for name in [*systems.names(), *_sound_systems()]
        for library in systems.find(name).libraries
    ]


def _sound_systems() -> list[str]:
    """Return the names of systems that other packages bring and that can be imported."""
    from latticebench import systems

    found = []
    for name in systems.brought():
        with suppress(InputError):
            systems.find(name)
            found.append(name)
    return found


def _method_rows() -> list[dict[str, Any]]:
    from latticebench import methods
    from latticebench.methods.method import settings
    from latticebench.systems import packages

    rows = []
    for name in [*methods.registered(), *methods.brought()]:
        try:
            kind = methods.find(name)
        except InputError as error:
            rows.append({"name": name, "what it is": str(error), "settings": {}})
            continue
        # JSON has lists alone.
        values = {key: list(value) if isinstance(value, tuple) else value for key, value in settings(kind).items()}
        about = (kind.__doc__ or "").strip().splitlines()[0].partition("; ")[0].removesuffix(".")
        rows.append({"name": name, "what it is": about, "settings": values})
    taken = packages.hidden(packages.METHODS, methods.registered())
    return [*rows, *({"name": name, "what it is": why, "settings": {}} for name, why in taken.items())]


def _effect_rows() -> list[dict[str, Any]]:
    from latticebench.systems.effects import CATALOGUE

    return [
        {
            "name": one.name, "second order, real": next(iter(one.texts(2, False)), ""),
            "first order, complex": next(iter(one.texts(1, True)), ""), "how it acts": one.how,
            "what gives it away": one.look_for, "source": one.source,
        }
        for one in CATALOGUE
    ]  # fmt: skip


def _suite_rows() -> list[dict[str, Any]]:
    from latticebench.systems.toml import read_toml

    return [{"name": path.stem, "what it is for": read_toml(path).get("title", "")} for path in suite_files()]
