"""Arrays beyond the memory: kept in files, gone through in pieces, and read from where they are written."""

import errno
import os
import weakref

import numpy as np
import pytest

from latticebench.systems import arrays, npz, readers, simulate, writers
from latticebench.systems.arrays import empty, pieces
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

DRAW = np.random.default_rng(4)
T, U, V = np.linspace(0, 1, 9), DRAW.normal(size=(9, 40)), DRAW.normal(size=(9, 40))


@pytest.fixture
def small_memory(monkeypatch):
    for module in (arrays, npz, writers):
        monkeypatch.setattr(module, "IN_MEMORY", 1000)
    # What other tests still hold takes nothing of it.
    monkeypatch.setattr(arrays, "_in_use", weakref.WeakValueDictionary())


def base_of(array):
    while getattr(array, "base", None) is not None and not isinstance(array, np.memmap):
        array = array.base
    return array


@pytest.mark.parametrize(("count", "size", "most"), [(10, 3, 7), (1, 100, 7), (7, 0, 3), (6, 2, 4), (0, 3, 9)])
def test_pieces_go_through_all_rows_once_and_are_as_small_as_asked(count, size, most):
    found = list(pieces(count, size, most))
    assert [row for some in found for row in range(some.start, some.stop)] == list(range(count))
    assert all((some.stop - some.start) * size <= most or some.stop - some.start == 1 for some in found)


def test_a_large_array_is_a_mapped_file_without_a_name_and_a_small_one_is_none(small_memory, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    large, small = empty((20, 30), complex), empty((3, 4))
    assert isinstance(large, np.memmap)
    assert not isinstance(small, np.memmap)
    large[:] = 1 + 2j
    assert np.sum(large) == 600 * (1 + 2j)
    assert os.listdir(tmp_path) == []


def test_arrays_in_use_share_the_memory_and_give_it_back(small_memory):
    first = empty((100,))
    assert isinstance(empty((30,)), np.memmap)
    view = first[2:]
    del first
    assert isinstance(empty((30,)), np.memmap)
    del view
    assert not isinstance(empty((100,)), np.memmap)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system reserves no room")
def test_a_disk_without_room_for_an_array_is_told(small_memory, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match="TMPDIR"):
        empty((20, 30))


def test_large_samples_are_written_as_they_are_and_read_from_the_file(small_memory, tmp_path):
    path = tmp_path / "large.npz"
    writers.write([Samples(T, U, V)], path)
    (found,) = readers.read(path)
    assert isinstance(base_of(found.u), np.memmap)
    for name, wanted in (("t", T), ("u", U), ("v", V)):
        np.testing.assert_array_equal(getattr(found, name), wanted)
    assert not found.has_missing
    with np.load(path) as other:
        np.testing.assert_array_equal(other["v"], V)


def test_several_large_trajectories_keep_their_order(small_memory, tmp_path):
    path = tmp_path / "several.npz"
    writers.write([Samples(T, U), Samples(T, V)], path)
    first, second = readers.read(path)
    np.testing.assert_array_equal(first.u, U)
    np.testing.assert_array_equal(second.u, V)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", [np.float32, np.float64, np.complex128, np.int16])
def test_a_large_file_of_someone_elses_has_any_order_and_kind_of_number(small_memory, tmp_path, kind, order):
    path, u = tmp_path / "other.npz", np.asarray(100 * U, order=order).astype(kind)
    np.savez(path, t=T, u=u)
    np.testing.assert_array_equal(readers.read(path)[0].u, u)


def test_a_large_file_that_is_cut_off_is_refused(small_memory, tmp_path):
    path = tmp_path / "cut.npz"
    np.savez(path, t=T, u=U)
    whole = path.read_bytes()
    for share in (0.3, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="NPZ"):
            readers.read(path)


@pytest.mark.parametrize("field", [U, U + 1j * V], ids=["real", "complex"])
def test_noise_and_gaps_do_not_depend_on_the_pieces_that_they_are_drawn_in(monkeypatch, field):
    clean = simulate.SimulatedSamples(T, field, source="own")
    seen = []
    for most in (10**6, 90):
        monkeypatch.setattr(simulate, "rows_of", lambda array, most=most: pieces(len(array), array.shape[1], most))
        seen.append(simulate.observe(clean, np.random.default_rng(1), noise=0.1, missing=0.2).u)
    np.testing.assert_array_equal(np.isnan(seen[0]), np.isnan(seen[1]))
    np.testing.assert_allclose(seen[0], seen[1], rtol=1e-12)


def test_a_value_that_is_infinite_is_told_with_its_place_beyond_the_first_piece(monkeypatch):
    monkeypatch.setattr("latticebench.systems.samples.rows_of", lambda array: pieces(len(array), 1, 2))
    u = U.copy()
    u[5, 3] = np.inf
    with pytest.raises(InputError, match="row 6, column u4"):
        Samples(T, u)
    u[5, 3] = np.nan
    assert Samples(T, u).has_missing
