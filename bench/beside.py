"""Results of a run beside published ones of the same cases."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from latticebench.bench.provenance import describe
from latticebench.bench.published import folder_of, read_head
from latticebench.bench.store import is_store, open_store
from latticebench.bench.tables import ABOUT, SHOWN, file_of_cases, read_cases, takes_truth
from latticebench.systems.errors import InputError


@dataclass(frozen=True, eq=False)
class Published:
    """Results of other runs.

    Attributes:
        cases: their table of cases.
        about: in words, where they are from.
        commits: what made them.
        file: that they were read from.
        mark: stands behind the names of their methods.
    """

    cases: pd.DataFrame
    about: str
    commits: str
    file: Path = Path()
    mark: str = "*"

    def joined(self, own: pd.DataFrame) -> pd.DataFrame:
        """Return a table of cases with the published rows of the same cases.

        Two cases are the same if they differ in their methods alone. A published row has the mark in its method, and in
        the column `published` the commit that made it, which is empty in one's own. Where a case stands in several
        parts of what was published, one's own row is repeated in each.

        Raises:
            InputError: no case is in both.
        """
        mine = own.assign(case=own["identity"].map(without_method), published="")
        known = set(mine["case"])
        theirs = self.cases.assign(case=self.cases["identity"].map(without_method), published=self.commits)
        theirs = theirs[theirs["case"].isin(known)]
        if theirs.empty:
            raise InputError(f"{self.about}: it has none of these cases; give what was published of the same suite")
        theirs = theirs.assign(
            method=[_named(*pair, self.mark) for pair in zip(theirs["method"], theirs["identity"], strict=True)]
        )
        places = theirs[["case", *ABOUT]].drop_duplicates().reset_index(drop=True).reset_index(names="place")
        mine = mine.merge(places, on="case", how="left", suffixes=("", "_there"))
        mine = mine.sort_values("place", kind="stable", na_position="last")
        for name in ABOUT:
            mine[name] = mine[f"{name}_there"].where(mine[f"{name}_there"].notna(), mine[name])
        columns = [*own.columns, "published"]
        both = [mine[columns], theirs.reindex(columns=columns)]
        filled = [part.dropna(axis="columns", how="all") for part in both]
        return pd.concat(filled, ignore_index=True).reindex(columns=columns)


def read_published(folder: Path) -> Published:
    """Read what was published, or the store of another run.

    Args:
        folder: a folder or a table; or the name of one in `results` of a copy of this project's repository.

    Raises:
        InputError: there is no table of cases.
    """
    if not os.path.exists(folder) and folder_of(str(folder)).is_dir():
        folder = folder_of(str(folder))
    cases = read_cases(folder)
    file = file_of_cases(folder)
    if is_store(folder):
        store = open_store(folder)
        with store.sound():
            commits = describe(store.origins(), {})["commit"]
    else:
        commits = [read_head(file).get("commit", "unknown")]
    told = " and ".join(commits)
    # Where it lies on this machine is nobody's business.
    return Published(cases, f"{'/'.join(folder.resolve().parts[-2:])}, commit {told}", told, file)


def without_method(identity: str) -> str:
    """Return which case it is, whoever fits it: its identity without the method and its settings.

    Raises:
        InputError: it is no identity.
    """
    content = content_of(identity)
    return json.dumps({name: content[name] for name in content if name not in ("method", "settings")}, sort_keys=True)


def _named(label: str, identity: str, mark: str) -> str:
    """Return what a published method is called; tables of earlier versions do not mark those that see the truth."""
    plain = label.removesuffix(SHOWN)
    truth = plain != label or takes_truth(str(content_of(identity).get("method")))
    return f"{plain}{mark}{SHOWN if truth else ''}"


def content_of(identity: str) -> dict[str, Any]:
    """Return the settings that an identity is made of.

    Raises:
        InputError: it is no identity.
    """
    try:
        found = json.loads(identity)
    except (ValueError, TypeError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise InputError(f"{identity!r} is no identity of a case; is the table one of `latticebench table`?")
    return found
