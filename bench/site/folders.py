"""What lies in a folder of published results: tables, texts, pictures, diagnoses, and other files."""

from __future__ import annotations

import math
import os
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pydantic

from latticebench.bench.published import read_rows
from latticebench.bench.report.content import DiagnosisDocument
from latticebench.bench.store import is_store
from latticebench.systems.errors import InputError, printable
from latticebench.systems.files import DATA, check_regular, read_json, read_text, reading, shown

# What programs leave beside files.
LEFT_OUT = ("__pycache__",)
PNG = b"\x89PNG\r\n\x1a\n"
# Elements and words that make an SVG more than a picture, and what it may refer to.
ACTIVE = ("script", "foreignobject", "iframe", "object", "embed", "handler", "animate", "set", "animatemotion")
LOADING = re.compile(r"<!ENTITY|<\?xml-stylesheet|@import|javascript:|url\(\s*[\"']?(?!#)[^\s\"'#]", re.IGNORECASE)
OWN = re.compile(r"#|data:image/(?:png|jpeg);")
# A folder within a folder within ... is no folder of results.
MOST_NESTED = 5
MOST_FILES = 10_000


@dataclass(frozen=True)
class Table:
    """A table of a CSV file, each cell as it is there.

    Attributes:
        columns: the header.
        rows: cells, as many in each as there are columns.
        about: the lines above the header, in two parts: what it is, and what is said of it ("command", ...).
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    about: tuple[tuple[str, str], ...] = ()

    def column(self, name: str) -> list[str]:
        """Return the cells of a column."""
        place = self.columns.index(name)
        return [row[place] for row in self.rows]

    def records(self) -> Iterator[dict[str, str]]:
        """Yield each row by the names of the columns."""
        return (dict(zip(self.columns, row, strict=True)) for row in self.rows)

    def has(self, *names: str) -> bool:
        """Return whether there are columns of these names."""
        return set(names) <= set(self.columns)

    def said(self, name: str) -> str:
        """Return what the lines above the header say of something; nothing where they do not."""
        return dict(self.about).get(name, "")


@dataclass(frozen=True)
class Folder:
    """A folder of published results, by the names of its files without their endings.

    Attributes:
        path: where it is.
        parts: its name in the site, and those of the folders around it.
        files: the names of all its files.
        tables: of the CSV files.
        texts: of Markdown files that are more than another form of a table.
        pictures: PNG and SVG files by their whole names, with width and height in pixels (0 where it is not known).
        diagnoses: of JSON files.
        folders: within it.
    """

    path: Path
    parts: tuple[str, ...]
    files: tuple[str, ...]
    tables: Mapping[str, Table]
    texts: Mapping[str, str]
    pictures: Mapping[str, tuple[int, int]]
    diagnoses: Mapping[str, DiagnosisDocument]
    folders: tuple[Folder, ...]

    @property
    def name(self) -> str:
        """Its name in the site, with those of the folders around it."""
        return "/".join(self.parts)


def read_folder(path: Path, parts: tuple[str, ...]) -> Folder:
    """Read a folder of published results with all that is in it.

    Args:
        path: the folder.
        parts: its name in the site, and those of the folders around it.

    Raises:
        InputError: it is no such folder, has nothing in it, or a file of it is damaged.
    """
    if not os.path.isdir(path):
        missing = "a file, not a folder of published tables" if os.path.lexists(path) else "no such folder"
        raise InputError(f"{shown(path)}: {missing}")
    if is_store(path):
        told = f"latticebench table {shown(path)} --out results/{shown(path.name)}"
        raise InputError(f"{shown(path)}: results of a run; publish their tables first: {told}")
    if len(parts) > MOST_NESTED:
        raise InputError(f"{shown(path)}: folders within folders, more than {MOST_NESTED} deep; give those with tables")
    files = _inside(path)
    folders = tuple(read_folder(one, (*parts, one.name)) for one in files if os.path.isdir(one))
    files = [one for one in files if not os.path.isdir(one)]
    for one in files:
        check_regular(one)
        if one.suffix.lower() == ".svg":
            check_still(one)
    by_ending = {ending: [one for one in files if one.suffix.lower() == ending] for ending in ENDINGS}
    texts = {one.stem: read_text(one) for one in by_ending[".md"]}
    diagnoses = {one.stem: read_diagnosis(one) for one in by_ending[".json"]}
    return Folder(
        path, parts, tuple(one.name for one in files), {one.stem: read_table(one) for one in by_ending[".csv"]},
        {stem: text for stem, text in texts.items() if not text.lstrip().startswith("|")},
        {one.name: png_size(one) for one in by_ending[".png"]} | {one.name: (0, 0) for one in by_ending[".svg"]},
        {stem: found for stem, found in diagnoses.items() if found is not None}, folders,
    )  # fmt: skip


ENDINGS = (".csv", ".md", ".json", ".png", ".svg")


def _inside(path: Path) -> list[Path]:
    """Return what a folder holds, by name.

    Raises:
        InputError: it cannot be read, is empty, holds too much, a name has signs that cannot be shown, or a link leads
            out of the folder.
    """
    try:
        names = sorted(name for name in os.listdir(path) if not name.startswith(".") and name not in LEFT_OUT)
    except OSError as error:
        raise InputError(f"{shown(path)}: {error.strerror}") from None
    if not 0 < len(names) <= MOST_FILES:
        held = f"more than {MOST_FILES} files are" if names else "there is nothing"
        raise InputError(f"{shown(path)}: {held} in it; give a folder of `latticebench table DIR --out`")
    if odd := [name for name in names if name != printable(name)]:
        raise InputError(f"{shown(path / odd[0])}: a name with signs that cannot be shown; rename it")
    own = Path(os.path.realpath(path))
    if out := [name for name in names if own not in Path(os.path.realpath(path / name)).parents]:
        raise InputError(
            f"{shown(path / out[0])}: a link to what does not lie in the folder; replace it by what is to be published"
        )
    return [path / name for name in names]


def read_table(path: Path) -> Table:
    """Read a published table.

    Raises:
        InputError: it is none, or cells are missing; the message names the row.
    """
    head, columns, rows = read_rows(path)
    parts = (line.removeprefix("#").strip().partition(": ") for line in head)
    about = tuple((name, value) if value else ("note", name) for name, _, value in parts)
    return Table(tuple(columns), tuple(map(tuple, rows)), about)


def read_diagnosis(path: Path) -> DiagnosisDocument | None:
    """Read the JSON document of a diagnosis; None where it is another document.

    Raises:
        InputError: it is no JSON, or says that it is a diagnosis and is none.
    """
    found = read_json(path)
    if not isinstance(found, dict) or found.get("schema") != DiagnosisDocument.model_fields["schema_"].default:
        return None
    try:
        document = DiagnosisDocument.model_validate(found)
        if document.shown is not None:
            document.shown.overlay()
        return document
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(f"{shown(path)}: not a whole diagnosis: {printable(place)}: {first['msg']}") from None
    except ValueError as error:
        raise InputError(f"{shown(path)}: not a whole diagnosis: shown: {error}; write it again") from None


def png_size(path: Path) -> tuple[int, int]:
    """Return width and height of a PNG in pixels.

    Raises:
        InputError: it is none.
    """
    with reading(path, DATA) as file:
        head = file.read(24)
    if len(head) < 24 or not head.startswith(PNG):
        raise InputError(f"{shown(path)}: not a PNG; draw it again")
    width, height = struct.unpack(">II", head[16:])
    return int(width), int(height)


def check_still(path: Path) -> None:
    """Make sure that an SVG does nothing but show itself: a browser runs what it holds.

    Raises:
        InputError: it is none, or has a script, an action or an element of another language, or loads something.
    """
    text = read_text(path, DATA)
    found = LOADING.search(text)
    try:
        wrong = found[0] if found else next(_actions(ElementTree.fromstring(text)), "")
    except ElementTree.ParseError as error:
        raise InputError(f"{shown(path)}: not an SVG: {error}; draw it again") from None
    if wrong:
        raise InputError(f"{shown(path)}: {wrong!r} in it could run or load something; draw it again, or leave it out")


def _actions(picture: ElementTree.Element) -> Iterator[str]:
    """Yield what an SVG could do besides showing itself."""
    for element in picture.iter():
        name = str(element.tag).rpartition("}")[2].lower()
        if name in ACTIVE:
            yield f"<{name}"
        for key, value in element.items():
            attribute = key.rpartition("}")[2].lower()
            if attribute.startswith("on") or (attribute == "href" and not OWN.match(value.strip())):
                yield f"{attribute}="


def value_of(cell: str) -> float:
    """Return the number that a cell holds; NaN where it holds none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def is_numeric(cells: list[str]) -> bool:
    """Return whether a column holds numbers, and nothing else but empty cells."""
    filled = [cell for cell in cells if cell]
    return bool(filled) and not any(math.isnan(value_of(cell)) and cell.lower() != "nan" for cell in filled)
