"""Writing: a file appears whole or not at all."""

import subprocess
import sys
import textwrap

import numpy as np
import pandas as pd
import pytest

from latticebench.systems import files
from latticebench.systems.errors import InputError
from latticebench.systems.readers import FORMATS
from latticebench.systems.samples import Samples
from latticebench.systems.writers import write


def some(sites=2, is_complex=False, v=False, f=False):
    u = np.ones((3, sites)) * (1j if is_complex else 1.0)
    return Samples(np.arange(3.0), u, np.ones((3, sites)) if v else None, np.ones((3, sites)) if f else None)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("data", [[], [some(), some(sites=3)], [some(), some(v=True)], [some(), some(is_complex=True)]])
def test_trajectories_that_do_not_fit_together_are_not_written(tmp_path, suffix, data):
    with pytest.raises(InputError):
        write(data, tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_full_disk_leaves_the_old_file_as_it_was(tmp_path, suffix):
    path = tmp_path / f"data{suffix}"
    write([some()], path)
    before = path.read_bytes()
    # The limit on a file's size stands for the end of the disk; it is set in a process of its own.
    script = textwrap.dedent(f"""
        import resource
        from pathlib import Path
        import numpy as np
        import pandas, pyarrow.parquet
        from latticebench.systems.errors import InputError
        from latticebench.systems.samples import Samples
        from latticebench.systems.writers import write
        u = np.random.default_rng(0).normal(size=(3000, 5))
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        try:
            write([Samples(np.arange(3000.0), u)], Path({str(path)!r}))
        except InputError as error:
            print(error)
    """)
    pytest.importorskip("resource")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout.startswith(f"{path}: cannot be written"), done.stderr[-500:]
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), MemoryError()])
def test_a_write_that_breaks_off_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, error):
    path = tmp_path / "data.csv"
    write([some()], path)
    before = path.read_bytes()

    def breaks_off(self, target, **_):
        target.write_text("t,u1\n0,")
        raise error

    monkeypatch.setattr(pd.DataFrame, "to_csv", breaks_off)
    with pytest.raises(InputError if isinstance(error, OSError) else type(error)) as caught:
        write([some(sites=3)], path)
    if isinstance(error, OSError):
        assert str(caught.value).startswith(str(path))
        assert "No space left" in str(caught.value)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["data.csv"]


def test_a_disk_that_fills_up_at_the_end_leaves_the_old_text(tmp_path, monkeypatch):
    path = tmp_path / "notes.txt"
    files.write_text(path, "old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        files.write_text(path, "new")
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_path_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder.csv").mkdir()
    for path in (tmp_path / "file" / "a.csv", tmp_path / "folder.csv"):
        with pytest.raises(InputError, match="cannot be written"):
            write([some()], path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.csv"]


def test_a_new_file_is_readable_as_others_are_and_folders_are_made(tmp_path):
    path = tmp_path / "new" / "deep" / "a.csv"
    write([some()], path)
    plain = tmp_path / "plain"
    plain.write_text("x")
    assert path.stat().st_mode == plain.stat().st_mode
