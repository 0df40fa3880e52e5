"""The pages of a site, from templates that escape every text; style and script stand in each page."""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from latticebench.bench.plots import plot
from latticebench.bench.provenance import lines
from latticebench.bench.report import rows
from latticebench.bench.report.content import DiagnosisDocument
from latticebench.bench.site.folders import Folder, Table, is_numeric, value_of
from latticebench.bench.site.prose import rendered
from latticebench.bench.site.suites import View, of_fits, of_trials
from latticebench.bench.suite import file_of, names
from latticebench.systems.toml import read_toml

if TYPE_CHECKING:
    import jinja2

    from latticebench.bench.report.shown import Shown

# Where copies of the files lie.
COPIES = "files"
# A table of so many rows or fewer stands on the page of its folder, a longer one on its own.
SHORT = 60
# A longer table is linked as a file: a browser would be slow.
LONGEST = 20_000
# A column of so few texts is one to choose rows by; so are these of numbers.
FEW = 40
SETTINGS = ("noise", "seed", "sites", "z")
MOST_FILTERS = 6
LABELS = {
    "data": "setting", "e2": "E2", "einf": "Einf", "tpr": "support", "e2_low": "E2, low", "e2_high": "E2, high",
    "forecast_error": "forecast error", "forecast_horizon": "forecast horizon", "cpu_seconds": "CPU seconds",
    "peak_mib": "peak MiB", "ok": "fits that ended", "seeds": "number of seeds",
}  # fmt: skip


@dataclass(frozen=True)
class Link:
    """A link: where it leads to, seen from a page, what it says, and what is said of it."""

    href: str
    text: str
    about: str = ""


def pages(folders: tuple[Folder, ...], about: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the path in the site and the HTML of each page.

    Args:
        folders: what is published.
        about: where the site comes from, see `bench.provenance`.
    """
    known = {path for folder in walk(folders) for path in _paths(folder)}
    draw = Drawing(environment(), known)
    yield "index.html", draw.page("index.html.j2", (), title="Results", cards=[_card(one) for one in folders],
        origin=[line.partition(": ")[::2] for line in lines(about)])  # fmt: skip
    for folder in walk(folders):
        yield from draw.folder(folder)


def walk(folders: tuple[Folder, ...]) -> Iterator[Folder]:
    """Yield folders with those within them."""
    for folder in folders:
        yield folder
        yield from walk(folder.folders)


def _paths(folder: Folder) -> Iterator[str]:
    """Yield the paths in the site of what a folder has: its pages, and copies of its files."""
    here = folder.name
    yield f"{here}/index.html"
    yield from (f"{COPIES}/{here}/{name}" for name in folder.files)
    yield from (f"{here}/text-{stem}.html" for stem in folder.texts)


class Drawing:
    """Draws pages.

    Args:
        templates: see `environment`.
        known: the paths in the site to which a text may link.
    """

    def __init__(self, templates: jinja2.Environment, known: set[str]) -> None:
        self._templates, self._known = templates, known
        self._style, self._script = (_source(templates, name) for name in ("site.css", "site.js"))

    def page(self, template: str, parts: tuple[str, ...], **shown: Any) -> str:
        """Return a page that lies in the folder of these parts."""
        above = [Link("../" * (len(parts) - k) + "index.html", name) for k, name in enumerate(("Results", *parts))]
        return self._templates.get_template(template).render(
            above=above, style=self._style, script=self._script, hashes=[_hash(self._style), _hash(self._script)],
            **shown,
        )  # fmt: skip

    def folder(self, folder: Folder) -> Iterator[tuple[str, str]]:
        """Yield the pages of a folder without those within it."""
        suite = of_fits(folder)
        long = {stem: one for stem, one in folder.tables.items() if not _stays(stem, one, suite)}
        here = {stem: _shown(stem, suite if suite and stem == "summary" else _view(one))
                for stem, one in folder.tables.items() if stem not in long}  # fmt: skip
        named = {stem: found for stem, one in folder.tables.items() if (found := of_trials(one)) is not None}
        trials = {stem: _shown(f"named-{stem}", View(one)) for stem, one in named.items()}
        yield f"{folder.name}/index.html", self.page(
            "folder.html.j2", folder.parts, title=folder.name, tables=here, trials=trials, suite=suite is not None,
            made=_made(folder), links=_links(folder, long), files=[_file(folder, name) for name in folder.files],
            pictures=_pictures(folder), within=[_card(one, folder.parts) for one in folder.folders],
        )  # fmt: skip
        for stem, table in long.items():
            if len(table.rows) <= LONGEST:
                yield f"{folder.name}/table-{stem}.html", self.page(
                    "table.html.j2", folder.parts, title=f"{folder.name}: {stem}", stem=stem,
                    table=_shown(stem, _view(table)), about=table.about, file=_file(folder, f"{stem}.csv"),
                )  # fmt: skip
        for stem, text in folder.texts.items():
            yield f"{folder.name}/text-{stem}.html", self.page(
                "text.html.j2", folder.parts, title=f"{folder.name}: {stem}",
                body=rendered(text, lambda target: self._target(folder, target)),
                file=_file(folder, f"{stem}.md"),
            )  # fmt: skip
        for stem, one in folder.diagnoses.items():
            drawn = f"diagnosis-{stem}.svg"
            if one.shown is not None:
                yield f"{folder.name}/{drawn}", _drawn(one.shown, drawn)
            yield f"{folder.name}/diagnosis-{stem}.html", self.page(
                "diagnosis.html.j2", folder.parts, title=f"{folder.name}: {stem}", stem=stem, report=one,
                picture=quote(drawn) if one.shown is not None else "",
                tables=_tables(one), about=[line.partition(": ")[::2] for line in lines(one.provenance.model_dump())],
                file=_file(folder, f"{stem}.json"),
            )  # fmt: skip

    def _target(self, folder: Folder, target: str) -> str | None:
        """Return where a link of a text in a folder leads to in the site, seen from the page of that text."""
        parts = list(folder.parts)
        for step in target.split("/")[:-1]:
            if step == ".." and parts:
                parts.pop()
            elif step not in (".", ""):
                parts.append(step)
        where, name = "/".join(parts), target.split("/")[-1]
        text = f"{where}/text-{name.removesuffix('.md')}.html"
        found = next((one for one in (text, f"{COPIES}/{where}/{name}") if one in self._known), None)
        return None if found is None else "../" * len(folder.parts) + quote(found)


def environment() -> jinja2.Environment:
    """Return the templates of this package; they escape what they are given, and refuse a name that is missing."""
    import jinja2
    import markupsafe

    found = jinja2.Environment(
        loader=jinja2.PackageLoader("latticebench.bench.site", "templates"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    found.filters["markup"] = markupsafe.Markup
    return found


def _source(templates: jinja2.Environment, name: str) -> str:
    text, _, _ = templates.loader.get_source(templates, name)  # type: ignore[union-attr]
    return text


def _hash(text: str) -> str:
    """Return by what a browser knows that a style or script is ours."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


# What a page shows ----------------------------------------------------------------------------------------------------


def _stays(stem: str, table: Table, suite: View | None) -> bool:
    """Return whether a table stands on the page of its folder."""
    return stem == "summary" if suite else len(table.rows) <= SHORT


def _view(table: Table) -> View:
    """Return a table with the columns by which its rows can be chosen."""
    filters = []
    for name in table.columns:
        column = table.column(name)
        if 1 < len(set(column)) <= min(FEW, len(column) / 2) and (name in SETTINGS or not is_numeric(column)):
            filters.append(name)
    return View(table, tuple(filters[:MOST_FILTERS]))


def _shown(stem: str, view: View) -> dict[str, Any]:
    """Return what the template of a table shows, and what its script reads."""
    table = view.table
    numeric = [is_numeric(table.column(name)) for name in table.columns]
    labels = [LABELS.get(name, name) for name in table.columns]
    cells = [
        [number(cell) if is_number else cell for cell, is_number in zip(row, numeric, strict=True)]
        for row in table.rows
    ]
    data = {
        "columns": [[name, label, one] for name, label, one in zip(table.columns, labels, numeric, strict=True)],
        "rows": table.rows, "filters": view.filters, "figure": view.figure or None, "details": view.details,
        "about": table.about,
    }  # fmt: skip
    link = table.columns.index("e2") if view.details else None
    return {
        "id": stem, "labels": labels, "numeric": numeric, "cells": cells, "data": data, "link": link,
        "note": view.note, "about": table.about,
    }  # fmt: skip


def number(cell: str) -> str:
    """Write the number of a cell with three digits; whole ones, and what is no number, as they are."""
    value = value_of(cell)
    if not math.isfinite(value):
        return cell
    if value == round(value) and abs(value) < 1e6:
        return f"{value:.0f}"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.2e}"


def _made(folder: Folder) -> list[tuple[str, tuple[tuple[str, str], ...]]]:
    """Return by what each table was made; tables that were made alike stand together."""
    found: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for stem, table in folder.tables.items():
        found.setdefault(table.about, []).append(stem)
    return [(", ".join(stems), about) for about, stems in found.items()]


def _links(folder: Folder, long: Mapping[str, Table]) -> dict[str, list[Link]]:
    """Return the pages of a folder by what they are."""
    tables = [
        Link(quote(f"table-{stem}.html"), stem, f"{len(one.rows)} rows")
        if len(one.rows) <= LONGEST
        else Link(_file(folder, f"{stem}.csv").href, stem, f"{len(one.rows)} rows, as a file")
        for stem, one in long.items()
    ]
    texts = [Link(quote(f"text-{stem}.html"), _heading(text) or stem) for stem, text in folder.texts.items()]
    diagnoses = [
        Link(quote(f"diagnosis-{stem}.html"), stem, f"{one.verdict}: {one.sentence}")
        for stem, one in folder.diagnoses.items()
    ]
    return {"Texts": texts, "Diagnoses": diagnoses, "More tables": tables}


def _drawn(shown: Shown, salt: str) -> str:
    """Draw the readings of a diagnosis and what both equations leave of them, as the text of an SVG file."""
    import matplotlib as mpl

    written = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": salt}):
        figure = plot(shown.overlay(), ["sites", "residual"], titled=False)
        figure.savefig(written, format="svg", metadata={"Date": None, "Creator": None}, dpi=140)
    return written.getvalue()


def _heading(text: str) -> str:
    first = text.lstrip().partition("\n")[0]
    return first.lstrip("# ") if first.startswith("#") else ""


def _purpose(about: Mapping[str, str]) -> list[str]:
    """Return what a suite of this package is for, by the command that ran it; nothing of another."""
    name = about.get("suite", "")
    if name not in names() or not f"{about.get('command', '')} ".startswith(f"latticebench run {name} "):
        return []
    return [str(read_toml(file_of(name))["title"])]


def _file(folder: Folder, name: str) -> Link:
    """Return the link from a page of a folder to the copy of a file of it."""
    size = (folder.path / name).stat().st_size
    about = f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{max(size / 1e3, 0.1):.1f} kB"
    return Link("../" * len(folder.parts) + quote(f"{COPIES}/{folder.name}/{name}"), name, about)


def _pictures(folder: Folder) -> list[tuple[Link, int, int]]:
    return [(_file(folder, name), width, height) for name, (width, height) in folder.pictures.items()]


def _card(folder: Folder, above: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return what the page above says of a folder."""
    suite, held = of_fits(folder), []
    if suite:
        kinds = len(set(zip(*(suite.table.column(one) for one in ("system", "data", "library", "noise")), strict=True)))
        held.append(f"{kinds} kinds of data and library, {len(set(suite.table.column('method')))} methods")
    held += [f"{len(one.rows)} {stem}" for stem, one in folder.tables.items() if stem in ("cases", "trials")]
    for found, word in ((folder.tables, "table"), (folder.diagnoses, "diagnosis"), (folder.pictures, "picture")):
        held.append(f"{len(found)} {word if len(found) == 1 else PLURALS[word]}" if found else "")
    about = next((dict(one.about) for one in folder.tables.values() if one.about), {})
    return {
        "link": Link(quote(f"{'/'.join(folder.parts[len(above) :])}/index.html"), folder.parts[-1]),
        "texts": _purpose(about) or [_heading(text) for text in folder.texts.values() if _heading(text)],
        "held": [one for one in held if one], "about": [(name, about[name]) for name in SAID if name in about],
        "folders": [one.parts[-1] for one in folder.folders],
    }  # fmt: skip


PLURALS = {"table": "tables", "diagnosis": "diagnoses", "picture": "pictures"}
SAID = ("command", "commit", "date")


def _tables(report: DiagnosisDocument) -> list[dict[str, Any]]:
    """Return the tables of a diagnosis, each with its title."""
    found = {
        "Declared terms": rows.coefficients(report), "What was added": rows.effects(report),
        "Errors": rows.errors(report), "Angular frequencies": rows.modes(report),
        "How the search went": rows.horizons(report), "What is left without a name": rows.left(report),
    }  # fmt: skip
    return [{"title": title, "columns": columns, "rows": body} for title, (columns, body) in found.items() if body]
