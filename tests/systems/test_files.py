"""Files: what is no regular file is neither read nor replaced, and places are checked before the work."""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path

import pytest

from latticebench.systems.errors import InputError
from latticebench.systems.files import (
    LARGEST,
    check_outputs,
    check_regular,
    read_bytes,
    read_json,
    read_text,
    shown,
    whole,
    write_text,
)
from latticebench.systems.toml import DEEPEST, read_toml

posix = pytest.mark.skipif(os.name != "posix", reason="pipes and devices as POSIX has them")


@posix
def test_pipes_sockets_devices_and_folders_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    before = Path.cwd()
    # A socket's path must be short.
    os.chdir(tmp_path)
    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind("socket")
    finally:
        os.chdir(before)
    for name, told in (("pipe", "a pipe"), ("device", "a device"), ("folder", "a folder"), ("missing", "no such file"),
                       ("loop", "loop"), ("socket", "socket"), ("x" * 300, "too long"), ("a\0b", "null")):  # fmt: skip
        for read in (read_bytes, read_text, read_json, read_toml, check_regular):
            with pytest.raises(InputError, match=told):
                read(tmp_path / name)


def test_a_file_is_read_up_to_a_size_that_can_be_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.txt"
    path.write_text("x" * (2**20 + 1))
    assert len(read_text(path)) == 2**20 + 1
    monkeypatch.setenv(LARGEST, "1")
    with pytest.raises(InputError, match=r"at most 1 are read.*--largest-file"):
        read_text(path)
    monkeypatch.setenv(LARGEST, "2")
    assert len(read_text(path)) == 2**20 + 1


@posix
def test_a_file_of_the_system_that_gives_more_than_its_size_is_cut_at_the_largest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(LARGEST, "1")
    assert 0 < len(read_bytes(Path("/proc/self/maps"))) <= 2**20


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"[" * 100_000, "nested too deeply"), (b"1" * 100_000, "too many digits"), (b"{", "not JSON"),
        (b"\xff", "line 1: not a text"), (b"1\n\0", "line 2: not a text"), (b"", "not JSON"),
    ],
)  # fmt: skip
def test_what_is_no_json_is_told_by_its_file(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=told) as caught:
        read_json(path)
    assert str(caught.value).startswith(str(path))


@posix
def test_what_is_no_regular_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("pipe", "null", "loop"):
        with pytest.raises(InputError):
            write_text(tmp_path / name, "x")
        with pytest.raises(InputError):
            check_outputs({"--json": tmp_path / name})
    assert sorted(one.name for one in tmp_path.iterdir()) == ["loop", "null", "pipe"]
    assert Path("/dev/null").is_char_device()


def test_an_output_is_neither_an_input_nor_another_output(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("x")
    with pytest.raises(InputError, match=r"--json .*in\.csv: this file is read"):
        check_outputs({"--json": tmp_path / "y" / ".." / "in.csv"}, [None, tmp_path / "in.csv"])
    with pytest.raises(InputError, match="--json writes to the same file"):
        check_outputs({"--json": tmp_path / "out", "--html": tmp_path / "." / "out"})
    check_outputs({"--json": tmp_path / "new" / "deep" / "out", "--html": None}, [tmp_path / "in.csv"])
    assert [one.name for one in tmp_path.iterdir()] == ["in.csv"]


def test_an_output_lies_in_no_folder_that_is_read(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.csv").write_text("x")
    (tmp_path / "link").symlink_to("data")
    for name in ("data/a.csv", "data/new/b.json", "link/a.csv"):
        with pytest.raises(InputError, match=r"--json .*: it lies in .*data, which the same command reads"):
            check_outputs({"--json": tmp_path / name}, [tmp_path / "data"])
    check_outputs({"--json": tmp_path / "data.json"}, [tmp_path / "data"])


def test_tables_within_tables_are_read_to_a_depth_that_functions_can_walk_through(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("\ufeff" + ".".join("a" * (DEEPEST - 1)) + " = 1\n")
    assert read_toml(path)
    for content in (".".join("a" * 3000) + " = 1", f"[{'.'.join('a' * 3000)}]", "a = " + "[" * 90 + "]" * 90):
        path.write_text(content)
        with pytest.raises(InputError, match=r"a\.toml: not TOML: it is nested too deeply"):
            read_toml(path)


def test_a_link_is_kept_and_an_interrupted_write_leaves_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")

    def break_off() -> None:
        with whole(tmp_path / "link") as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert (tmp_path / "real").read_text() == "old"
    write_text(tmp_path / "link", "new \ud800")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new \\ud800"
    assert len(list(tmp_path.iterdir())) == 2


def test_names_of_any_bytes_can_be_printed_and_encoded() -> None:
    for name in (os.fsdecode(b"\xff.csv"), "a\nb", "\x1b[31m", "ü"):
        assert shown(name).isprintable()
        assert json.loads(json.dumps(shown(name)).encode()) == shown(name)
    assert shown("ü") == "ü"
