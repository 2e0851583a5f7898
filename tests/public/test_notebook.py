"""The notebook, run as Jupyter runs it."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import rig

NOTEBOOK = Path(rig.__file__).parent / "examples" / "notebook" / "what_does_the_model_lack.ipynb"


def kinds_of_outputs(book):
    """Of each cell the kinds of its outputs: text, HTML, pictures."""
    return [
        [sorted(item.get("data", {item["output_type"]: 0})) for item in cell.get("outputs", [])]
        for cell in book.cells
    ]


@pytest.mark.long
def test_the_notebook_runs_and_finds_the_effect(tmp_path):
    book = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(book)
    saved = kinds_of_outputs(book)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(book, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    # Whoever reads it without running it sees the same.
    assert saved == kinds_of_outputs(book)
    pictures = [item for item in outputs if "image/png" in item.get("data", {})]
    assert len(pictures) == 2
    [table] = [item.data["text/html"] for item in outputs if "text/html" in item.get("data", {})]
    assert "explained: The model lacks" in table
    assert "cubic_stiffness" in table
    assert (tmp_path / "notebook" / "again" / "report.html").exists()


def test_what_is_saved_in_the_notebook_names_no_folder_of_a_machine():
    book = nbformat.read(NOTEBOOK, as_version=4)
    saved = [
        str(text)
        for cell in book.cells
        for output in cell.get("outputs", [])
        for kind, text in output.get("data", {}).items()
        if kind != "image/png"
    ]
    assert saved
    assert not [text for text in saved if "PosixPath" in text or "/home/" in text]
    assert max(map(len, saved)) < 2000
