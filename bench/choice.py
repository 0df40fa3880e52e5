"""Which part of a suite is run, and with which methods and seeds."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from latticebench import methods
from latticebench.bench.axes import read_seeds
from latticebench.bench.case import Case, code_file
from latticebench.bench.grid import Contestant
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.options import option

# What a pattern is compared with, besides the title of a case.
NAMED = ("part", "system", "data", "library", "label", "effect", "effects", "instrument", "name")


@dataclass(frozen=True)
class Choice:
    """A part of a suite, and the methods and seeds that it is run with; what is empty stays as the suite has it.

    Attributes:
        only: patterns with * and ?. A case is run if one of them matches its title, or its part, system, data, library,
            method, effect, instrument or name.
        methods: labels of the suite, names of methods, or .py files. A label is run on the blocks that have it, any
            other method on all blocks.
        seeds: of all cases that have one.
    """

    only: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()

    def __str__(self) -> str:
        """Say what was chosen; empty where nothing was."""
        parts = [("only", self.only), ("methods", self.methods), ("seeds", self.seeds)]
        return "; ".join(f"{name} {', '.join(map(str, given))}" for name, given in parts if given)

    def takes(self, case: Case) -> bool:
        """Return whether a case is run."""
        if not self.only:
            return True
        names = [case.title, *(getattr(case, name, "") for name in NAMED)]
        return any(fnmatchcase(str(name).casefold(), pattern.casefold()) for name in names for pattern in self.only)

    def contestants(self, own: Mapping[str, Contestant], base: Path | None) -> dict[str, Contestant]:
        """Return the methods that are run, by their labels.

        Args:
            own: those of the suite.
            base: the folder that paths in the suite start from; None if paths start from the working folder.

        Raises:
            InputError: there is no such method.
        """
        if not self.methods:
            return dict(own)
        registered, brought = methods.registered(), methods.brought()
        found: dict[str, Contestant] = {}
        for name in self.methods:
            if name in own:
                found[name] = own[name]
            elif code_file(name) is not None:
                path, _, wanted = name.rpartition(":") if ".py:" in name else (name, "", "")
                label = wanted or Path(path).stem
                taken = label in {*own, *found, *registered}
                found[name if taken else label] = Contestant(method=_from(base, path) + (wanted and f":{wanted}"))
            elif name in registered or name in brought:
                found[name] = Contestant(method=name)
            else:
                error = unknown("method", name, {*own, *registered, *brought}, option("methods"))
                raise InputError(f"{error} (or the path of a .py file)")
        return found

    def block(
        self, content: Mapping[str, Any], own: Iterable[str], contestants: Iterable[str]
    ) -> dict[str, Any] | None:
        """Return a block of fits with the methods and seeds that are run; None where it has none of the methods.

        Args:
            content: the block with its defaults.
            own: labels of the suite.
            contestants: labels that are run, see `contestants`.
        """
        block = self.with_seeds(content)
        if self.methods and isinstance(block.get("seeds_of"), dict):
            block["seeds_of"] = {label: seeds for label, seeds in block["seeds_of"].items() if label in contestants}
        had = content.get("methods", list(own))
        if not self.methods or not isinstance(had, list):
            return block
        labels = [label for label in contestants if label in had or label not in own]
        return {**block, "methods": labels} if labels else None

    def with_seeds(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return a block of any kind with the seeds that are run."""
        if not self.seeds:
            return {**content}
        return {**{key: value for key, value in content.items() if key != "seeds_of"}, "seeds": list(self.seeds)}


def chosen(
    only: Iterable[str] | None = None, given: Iterable[str] | None = None, seeds: str | Sequence[int] | None = None
) -> Choice:
    """Return the choice that a user makes.

    Args:
        only: patterns.
        given: methods; a text may name several, with commas between them.
        seeds: such as "1-5" or "1,3,7", or a list of them.

    Raises:
        InputError: a pattern or a method is empty, or these are no seeds.
    """
    patterns = tuple(only or ())
    names = tuple(dict.fromkeys(name.strip() for text in given or () for name in text.split(",")))
    for name, texts in (("only", patterns), ("methods", names)):
        if not all(text.strip() and "\0" not in text for text in texts):
            raise InputError(f"{option(name)}: one of them is empty; leave it out")
    try:
        return Choice(patterns, names, () if seeds is None else tuple(dict.fromkeys(read_seeds(seeds))))
    except ValueError as error:
        raise InputError(f"{option('seeds', str(seeds))}: {error}") from None


def _from(base: Path | None, path: str) -> str:
    """Return the path of a file as it is written from a folder; as it is given if there is none."""
    if base is None:
        return path
    full = Path(path).parent.resolve() / Path(path).name
    try:
        return Path(os.path.relpath(full, base)).as_posix()
    except ValueError:
        # On another drive.
        return str(full)
