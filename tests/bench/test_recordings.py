"""The measured recordings: what is said of them is so, and only a true copy is taken."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from commandline import refused, succeed
from latticebench.bench import recordings
from latticebench.bench.recordings import RECORDINGS, Recording, find, fingerprint, take
from latticebench.systems.errors import InputError
from latticebench.systems.readers import read

SHARED = Path(__file__).parents[3] / "shared" / "data" / "measured"


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder in which a small file is a recording called `swing`."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "downloaded file.csv"
    file.write_text("t,u1\n0,1\n1,0\n")
    swing = Recording("swing", "a swing", "t,u1", 2, "1 Hz", "a playground", "none", fingerprint(file))
    monkeypatch.setattr(recordings, "RECORDINGS", (swing,))
    return file


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda one: one.name)
def test_a_recording_is_what_it_is_said_to_be(recording: Recording) -> None:
    path = SHARED / f"{recording.name}.csv"
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    assert fingerprint(path) == recording.sha256
    with path.open() as file:
        assert file.readline().strip() == recording.columns
    (samples,) = read(path)
    assert len(samples.t) == recording.rows


def test_every_recording_names_its_source_licence_and_fingerprint() -> None:
    assert len({one.name for one in RECORDINGS}) == len(RECORDINGS)
    for one in RECORDINGS:
        assert one.source
        assert one.licence
        assert len(one.sha256) == 64


def test_the_list_is_text_for_people_and_json_for_programs(tmp_path: Path) -> None:
    rows = json.loads(succeed("data", "--json", cwd=tmp_path))["rows"]
    shown = succeed("data", cwd=tmp_path)
    assert [row["name"] for row in rows] == [one.name for one in RECORDINGS]
    for row in rows:
        for key in ("name", "what", "source", "licence", "sha256"):
            assert row[key] in shown


def test_a_true_copy_is_taken_to_the_usual_folder_a_folder_or_a_file(own: Path) -> None:
    assert take("swing", own) == (Path("data/swing.csv"), True)
    (own.parent / "there").mkdir()
    assert take("swing", own, Path("there")) == (Path("there/swing.csv"), True)
    assert take("swing", own, Path("new/other.csv")) == (Path("new/other.csv"), True)
    for path in ("data/swing.csv", "there/swing.csv", "new/other.csv"):
        assert Path(path).read_bytes() == own.read_bytes()


def test_a_copy_that_is_there_already_is_left_alone(own: Path) -> None:
    take("swing", own)
    assert take("swing", own) == (Path("data/swing.csv"), False)
    # The copy may be the original itself.
    assert take("swing", own, own) == (own, False)


def test_another_file_is_refused_and_leaves_nothing_behind(own: Path) -> None:
    other = own.parent / "other.csv"
    other.write_text("t,u1\n0,1\n1,0.1\n")
    with pytest.raises(InputError, match="SHA-256"):
        take("swing", other, Path("new"))
    assert not Path("new").exists()


def test_another_file_at_the_place_is_kept(own: Path) -> None:
    Path("mine.csv").write_text("mine")
    with pytest.raises(InputError, match="another file is there already"):
        take("swing", own, Path("mine.csv"))
    assert Path("mine.csv").read_text() == "mine"


@pytest.mark.parametrize("missing", ["nothing.csv", "."])
def test_what_is_no_file_cannot_be_taken(own: Path, missing: str) -> None:
    with pytest.raises(InputError, match=r"no such file|a folder"):
        take("swing", Path(missing))


def test_an_unknown_recording_is_answered_with_the_nearest() -> None:
    with pytest.raises(InputError, match="did you mean 'gliders'"):
        find("glider")


def test_the_command_takes_a_copy_and_complains_in_one_line(own: Path) -> None:
    out = succeed("data", "take", "swing", own.name, "kept", cwd=own.parent)
    assert out == f"{Path('kept/swing.csv')}: copied, SHA-256 as it should be\n"
    own.write_text("t,u1\n")
    line = refused("data", "take", "swing", own.name, "again", cwd=own.parent)
    assert line.startswith("error: downloaded file.csv: its SHA-256 is ")
