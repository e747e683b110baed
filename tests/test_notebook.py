"""The notebook of the documentation runs as it stands."""

import os
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "notebooks" / "first_map.ipynb"


@pytest.mark.long
def test_the_first_map_is_made(tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    # Its shell commands are those of this environment.
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in code), "outputs are not kept in the repository"
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    texts = ["".join(output.get("text", "") for output in cell.outputs) for cell in code]
    assert "60 scans" in texts[1]
    assert "last scan: ok" in texts[1]
    assert float(texts[2].split("ATE ")[1].split()[0]) < 0.03
    assert (tmp_path / "runs" / "office" / "map.ply").is_file()
    assert any("image/png" in output.get("data", {}) for output in code[-1].outputs)
