"""A folder of published results with labels that attack, and the site that is made of it."""

from __future__ import annotations

import html.parser
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from latticebench.bench.publish import render
from latticebench.bench.site.build import build
from latticebench.bench.tables import CASES, summary

RESULTS = Path(__file__).parents[3] / "results"
HOSTILE = ("<script>alert(1)</script>", "[/x]", "$\\input{x}$", "=1+1", "{{ 7*7 }}", "</script><b>", '"><img src=x>')
ABOUT = {
    "command": "latticebench run mine.toml", "settings": dict.fromkeys(HOSTILE, "tried, a=1"),
    "commit": "0123456789ab", "date": "2026-01-01", "machine": "<i>machine</i>, 2 cores", "seeds": [1, 2, 3],
}  # fmt: skip


def cases() -> pd.DataFrame:
    """Two kinds of data at two levels of noise, a method for each hostile label, three seeds; some fail."""
    rows: list[dict[str, Any]] = []
    for data in ("one C=2", "one C=2 noise=0.01", "two", "two noise=0.1"):
        for place, method in enumerate(HOSTILE):
            for seed in (1, 2, 3):
                failed = method == "[/x]" and seed > 1
                e2 = None if failed else 10.0 ** -(place + seed)
                noise = float(data.partition("noise=")[2] or 0)
                rows.append(
                    {
                        "part": "", "data": data, "library": "lib|1", "method": method, "noise": noise, "seed": seed,
                        "status": "failed" if failed else "ok", "e2": e2, "seconds": 0.25 * seed + place,
                        "forecast_error": e2, "reason": "a <b>reason</b>" if failed else "",
                        "identity": json.dumps({"system": data, "label": method}),
                    }
                )  # fmt: skip
    return pd.DataFrame(rows, columns=list(CASES))


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables as `latticebench table` writes them, a text, and a file of another kind."""
    folder = tmp_path_factory.mktemp("published") / "mine"
    (folder / "within").mkdir(parents=True)
    frame = cases()
    (folder / "cases.csv").write_text(render(frame, ABOUT, "csv"))
    (folder / "summary.csv").write_text(render(summary(frame), ABOUT, "csv"))
    (folder / "which.md").write_text(
        "# Which <b>one</b>\n\nSee [the table](summary.csv), [nothing](none.md), [bad](javascript:alert(1)).\n\n"
        "<script>alert(1)</script>\n\n| a | b |\n|:--|--:|\n| 1 | 2 |\n"
    )
    (folder / "script.py").write_text("print('a file of another kind')\n")
    (folder / "within" / "trials.csv").write_text(
        "effect,status,named,right\ndamping,ok,damping,True\ndamping,ok,,False\ndamping,failed,,\n"
    )
    return folder


@pytest.fixture(scope="session")
def site(published: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "site"
    build([published], out, {"command": "latticebench publish"})
    return out


@pytest.fixture(scope="session")
def whole_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site of all that is published here."""
    out = tmp_path_factory.mktemp("whole") / "site"
    build(sorted(one for one in RESULTS.iterdir() if one.is_dir()), out, {"command": "latticebench publish"})
    return out


class Page(html.parser.HTMLParser):
    """What a page holds, as a parser of HTML sees it.

    Attributes:
        tables: the cells of each table, row by row.
        data: the JSON beside them.
        links: where it leads to.
        tags: the names of its elements.
        text: all that is shown.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.data: list[dict[str, Any]] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self._cell = False
        self._script = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        self.links += [value for name in ("href", "src") if (value := given.get(name))]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self._cell = True
        elif tag == "script":
            self._script = given.get("type") or "program"
            if self._script == "application/json":
                self._json = ""

    def handle_endtag(self, tag: str) -> None:
        self._cell = self._cell and tag not in ("td", "th")
        if tag == "script" and self._script == "application/json":
            self.data.append(json.loads(self._json))
        self._script = ""

    def handle_data(self, data: str) -> None:
        if self._script == "application/json":
            self._json += data
        elif not self._script:
            self.text += data
            if self._cell:
                self.tables[-1][-1][-1] += data


@pytest.fixture(scope="session")
def page() -> Callable[[Path], Page]:
    return Page
