"""Measured recordings that the diagnosis is tried on: what they are, who made them, and how to know a true copy.

None of them is part of this project, whose licence is not theirs. A user who has one takes a local copy of it; its
SHA-256 says that it is the one that the published results are of.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import DATA, reading, whole

# Where copies go unless told otherwise.
FOLDER = Path("data")
CHUNK = 1 << 20


@dataclass(frozen=True)
class Recording:
    """One measured recording, as a CSV file of this project's form.

    Attributes:
        name: what it is called; its file is NAME.csv.
        what: what moves, and how it was read, with units.
        columns: of the file.
        rows: number of sample times.
        sampling: how often it was read.
        source: where it was published.
        licence: under which terms, as far as that is known.
        sha256: of the file.
    """

    name: str
    what: str
    columns: str
    rows: int
    sampling: str
    source: str
    licence: str
    sha256: str


PENDULUM = "Kaheman et al., arXiv:2205.06231; repository dynamicslab/MultiArm-Pendulum"

RECORDINGS: tuple[Recording, ...] = (
    Recording(
        "gliders",
        "two gliders on an air track, with springs between them and to both walls, filmed; positions in whole pixels, "
        "each counted from a starting point of its own",
        "t,u1,u2", 495, "30 Hz (steps of 0.033 or 0.034 s)",
        "Schmidt & Lipson, Science 324, 81 (2009), real_double_linear_h_1.txt, as kept in "
        "erwincoumans/tiny-differentiable-simulator",
        "none stated for the data; the repository that keeps it is Apache-2.0",
        "ee6b1b9d9e27e0e2204fe3f96bb16cd80db6fc7c00be6a6e5d51c30dfc9c9cc1",
    ),
    Recording(
        "pendulum",
        "one physical pendulum that swings freely from 1.62 down to 0.26 rad; angle from rest in rad, read by an "
        "optical encoder in steps of 2 pi / 40000",
        "t,u1", 55001, "1 kHz", PENDULUM, "MIT",
        "5fd3a6b6b8aaadae813af8dc57bd179361dd7bd11fab959ac74c2bc4c1cb5898",
    ),
    Recording(
        "pendulum_tail",
        "the last swings of the same pendulum, from 0.066 rad to its stop",
        "t,u1", 6200, "1 kHz", PENDULUM, "MIT",
        "cc9fcc87411b48d0592e6ebe1945df43b12de1ce8e1f2d67a6d153efa2c9e37f",
    ),
    Recording(
        "carts",
        "two carts on a track, with springs between them and to both walls, released by hand; positions from rest in "
        "cm, read by two laser rangefinders that look from opposite ends, in steps of 0.068",
        "t,u1,u2", 461, "about 33 Hz (steps of 0.02, 0.03 or 0.04 s)",
        "Jeffreymaomao/Coupled-Oscillators.github.io, 2023-6-13-11-10.csv from 9.9 s on", "none stated",
        "a877beb2851d552c004446ead579ef3297ea95b77627a5e89ce338a5d07a1929",
    ),
    Recording(
        "silverbox",
        "an electronic circuit that behaves much like a Duffing oscillator (u1, V), driven by a known voltage (f1, V), "
        "both without their means: first noise of growing size, then ten multisine blocks with pauses",
        "t,u1,f1", 131072, "610.3515625 Hz",
        "Wigren & Schoukens, European Control Conference 2013, as kept in the history of antonior92/sysid-neuralnet",
        "free to download; no licence stated",
        "75f0805081b701d2d2e13d550fcd07ff520f0a8246af955199c765a7efc36f62",
    ),
)  # fmt: skip


def find(name: str) -> Recording:
    """Look a recording up by its name.

    Raises:
        InputError: there is none of that name.
    """
    for one in RECORDINGS:
        if one.name == name:
            return one
    raise unknown("recording", name, [one.name for one in RECORDINGS])


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises:
        InputError: it cannot be read.
    """
    found = hashlib.sha256()
    with reading(path, DATA) as file:
        while chunk := file.read(CHUNK):
            found.update(chunk)
    return found.hexdigest()


def take(name: str, origin: Path, place: Path | None = None) -> tuple[Path, bool]:
    """Copy a recording that the user has to where it is used, whole or not at all.

    Args:
        name: of the recording.
        origin: the file that the user has.
        place: the copy, or a folder for it; `data/` if not given.

    Returns:
        the copy, and whether it was made now: False where it was there already.

    Raises:
        InputError: no such recording, the file is not that recording, or another file stands at the place.
    """
    recording = find(name)
    place = FOLDER if place is None else place
    # A place without an ending that a recording could have is a folder.
    if os.path.isdir(place) or place.suffix.lower() != ".csv":
        place = place / f"{name}.csv"
    found = fingerprint(origin)
    if found != recording.sha256:
        raise InputError(
            f"{origin}: its SHA-256 is {found}, that of {name!r} is {recording.sha256}; this is another file, or the "
            f"same data in another form than {recording.rows} rows of {recording.columns}"
        )
    if os.path.lexists(place):
        if fingerprint(place) == found:
            return place, False
        raise InputError(f"{place}: another file is there already; move it away, or give another place")
    with whole(place) as temporary:
        shutil.copyfile(origin, temporary)
        if fingerprint(temporary) != recording.sha256:
            raise InputError(f"{origin}: it changed while it was copied; try again")
    return place, True
