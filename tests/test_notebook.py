"""A notebook shows what it is given; run where Jupyter's kernel is installed (`pip install nbclient ipykernel`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from latticebench.bench.demo import write_recording

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

FIRST = """import latticebench as lb
data = lb.read("pendula.csv", time="time_s", columns="theta_*_deg", scale="deg")
model = lb.Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
fit = lb.fit(data, model, method="trajectory")
"""
SHOWN = (
    "data", "data.plot()", "data.animate()", "data.to_frame()", "data.inspect(model)",
    "data.inspect(model).plot()", "model", "fit", "fit.table", "fit.covariance", "fit.confidence()", "fit.simulate()",
    "fit.residual", "fit.residual.plot()", "fit.plot()",
    "lb.diagnose(data, model)", "lb.limit(data, model)", 'lb.results("paper")',
    'lb.run("tiny", only=["phi4 noise*"], methods=["zero"])',
)  # fmt: skip


@pytest.mark.slow
def test_every_object_of_a_notebook_is_shown_as_html(tmp_path: Path) -> None:
    write_recording(tmp_path / "pendula.csv")
    book = nbformat.v4.new_notebook()
    book.cells = [nbformat.v4.new_code_cell(text) for text in (FIRST, *SHOWN)]
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown: dict[str, list[Any]] = {cell.source: cell.outputs for cell in book.cells[1:]}
    for text, outputs in shown.items():
        assert [one.output_type for one in outputs] == ["execute_result"], (text, outputs)
        assert set(outputs[0].data) >= {"text/plain", "text/html"}, text
        # No object shows itself by its address, nor for pages.
        assert " object at 0x" not in outputs[0].data["text/plain"], text
        assert len(outputs[0].data["text/plain"].splitlines()) < 80, text
