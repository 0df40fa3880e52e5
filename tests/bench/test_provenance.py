"""Provenance: what decides the last digits is written down."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info

from latticebench.bench.provenance import describe, kernels, lines, origin

ASK = "import numpy; from latticebench.bench.provenance import kernels; print(kernels())"
OPENBLAS = any(one["internal_api"] == "openblas" for one in threadpool_info())


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64") or not OPENBLAS, reason="kernels of OpenBLAS for x86")
def test_the_kernel_and_the_threads_are_those_that_the_environment_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Nehalem")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    told = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True).stdout
    assert "openblas" in told
    assert "Nehalem" in told
    assert "thread" in told


def test_torch_is_named_where_it_is_used_here_or_by_a_worker(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    assert "torch" not in kernels()
    # A stand-in in another process, since the real one takes seconds to load.
    (tmp_path / "torch.py").write_text(
        "class cpu:\n    get_cpu_capability = staticmethod(lambda: 'AVX9')\n"
        "class backends:\n    cpu = cpu\nget_num_threads = lambda: 3\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert kernels(["torch"]).endswith("torch AVX9 3 threads")
    (tmp_path / "torch.py").write_text("raise SystemExit(1)")
    assert kernels(["torch"]).endswith("torch unknown")
    cpu = SimpleNamespace(get_cpu_capability=lambda: "AVX8")
    here = SimpleNamespace(backends=SimpleNamespace(cpu=cpu), get_num_threads=lambda: 1)
    monkeypatch.setitem(sys.modules, "torch", here)
    assert kernels().endswith("torch AVX8 1 thread")


def test_a_description_has_the_kernels_and_reads_results_that_have_none() -> None:
    new = origin()
    old = {name: value for name, value in new.items() if name != "kernels"}
    assert describe([new, {**new, "kernels": "other"}], {})["kernels"] == sorted([new["kernels"], "other"])
    assert not any(line.startswith("kernels") for line in lines(describe([old], {})))
    assert any(line.startswith("kernels: ") for line in lines(describe([old, new], {})))
