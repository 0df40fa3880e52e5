"""A disk that is full at any point of any output: one clear line, nothing half-written, and the screen has the rest."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest

from commandline import FIT, SUITE, content, latticebench
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text

# joblib remarks that it has no room for what it shares.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
resource = pytest.importorskip("resource", reason="limits files as POSIX systems do")

# The command, the file or folder that it writes, and what the screen has all the same.
COMMANDS = {
    "fit": (["fit", "t.csv", *FIT, "--json", "r.json"], "r.json", "u'' ="),
    "limit": (["limit", "--system", "phi4", "--library", "lib1", "--json", "r.json"], "r.json", "bound"),
    "diagnose": (
        ["diagnose", "t.csv", "--system", "phi4", "--json", "r/r.json", "--html", "r/r.html"], "r", "Nothing is missing"
    ),
    "simulate csv": (["simulate", "phi4", "--sites", "5", "--out", "r.csv"], "r.csv", ""),
    "simulate npz": (["simulate", "phi4", "--sites", "5", "--out", "r.npz"], "r.npz", ""),
    "simulate parquet": (["simulate", "phi4", "--sites", "5", "--out", "r.parquet"], "r.parquet", ""),
    "table": (["table", "store", "--out", "r"], "r", "lib1"),
    "figures": (["figures", "store", "--out", "r"], "r", ""),
    "schema": (["schema", "--out", "r"], "r", ""),
}  # fmt: skip


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """Let no file become longer; what is written beyond fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def besides_store(folder: Path) -> dict[str, bytes]:
    """Return what is in a folder, but for the store, which SQLite looks after."""
    return {path: text for path, text in content(folder).items() if not path.startswith("store/")}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with samples and a store."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "s.toml").write_text(SUITE)
    assert latticebench("simulate", "phi4", "--sites", "5", "--samples", "12", "--out", "t.csv", cwd=folder)[0] == 0
    assert latticebench("run", "s.toml", "--jobs", "1", "--results", "store", cwd=folder)[0] == 0
    # Closes the store, as the end of a process does.
    gc.collect()
    return folder


def survive(made: Path, name: str, sizes: tuple[int, ...]) -> None:
    arguments, place, shown = COMMANDS[name]
    known = besides_store(made)
    for size in sizes:
        with room_for(size):
            code, out, err = latticebench(*arguments, cwd=made)
        told = (name, size, code, err)
        assert code in (0, 2), told
        assert code == 0 or (err.startswith("error: ") and err.count("\n") == 1), told
        assert shown in out or "store cannot be read now" in err.replace("/results.sqlite:", ""), told
        now = besides_store(made)
        new = {path: text for path, text in now.items() if known.get(path) != text}
        # What is there is whole: nothing ends where the room did, and nothing temporary is left.
        assert all(len(text) > 0 and (len(text) < size or code == 0) for text in new.values()), told
        assert all(path == place or path.startswith(f"{place}/") for path in new), (told, sorted(new))
        assert not any("/." in f"/{path}" for path in now), told
        for path in new:
            (made / path).unlink()


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "diagnose"])
def test_an_output_on_a_full_disk_is_whole_or_not_there(name: str, made: Path) -> None:
    survive(made, name, (0, 700))


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_an_output_on_a_disk_that_is_full_at_many_points_is_whole_or_not_there(name: str, made: Path) -> None:
    survive(made, name, (0, 1, 100, 1000, 3000, 10_000, 30_000))


@pytest.mark.parametrize(
    ("arguments", "left", "shown"),
    [
        (
            ["fit", "t.csv", *FIT, "--json", "r.json", "--html", "r.html"],
            "r.html",
            "u'' =",
        ),
        (["inspect", "t.csv", "--json", "r.json", "--out", "r.svg"], "r.svg", "main angular frequencies"),
    ],
)
def test_where_one_place_fails_the_other_output_is_written_and_the_screen_has_it(
    arguments: list[str], left: str, shown: str, made: Path
) -> None:
    told = "r.json: cannot be written: the disk has failed"

    def failing(path: Path, text: str) -> None:
        if path.name == "r.json":
            raise InputError(told)
        write_text(path, text)

    with mock.patch("latticebench.systems.files.write_text", failing):
        code, out, err = latticebench(*arguments, cwd=made)
    assert (code, err) == (2, f"error: {told}\n")
    assert shown in out
    assert (made / left).stat().st_size > 0
    (made / left).unlink()
