"""Pages of evidence: each ends with how it came about."""

import importlib.util
import re
import shlex

import pytest

from tests import evidence

PAGES = sorted(evidence.FOLDER.glob("*.md"))
ORIGIN = re.compile(
    r"\n\nMeasured with\n\n    (?P<command>.+)\n\n"
    r"on \d{4}-\d\d-\d\d, rig \S+ \(commit \w+\), Python [^\n]+ cores[^\n]*\.\n\Z"
)


def module_of(command):
    """Module that a command `python -m MODULE ...` runs."""
    program, option, module, *_ = shlex.split(command)
    assert (program, option) == ("python", "-m")
    return module


def runs(module):
    """Whether `python -m` finds a module, or the `__main__` of a package."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.submodule_search_locations is None:
        return spec is not None
    return importlib.util.find_spec(f"{module}.__main__") is not None


def test_there_are_pages():
    assert PAGES


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_ends_with_its_command_date_and_version(path):
    text = path.read_text("utf-8")
    assert text.startswith("# ")
    found = ORIGIN.search(text)
    assert found
    assert runs(module_of(found["command"]))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_row_of_a_table_has_the_cells_of_its_head(path):
    cells = []
    for line in [*path.read_text("utf-8").splitlines(), ""]:
        if not line.startswith("|"):
            assert len(set(cells)) <= 1
            cells = []
        else:
            cells.append(line.count("|"))


def test_a_page_as_a_program_writes_it(tmp_path, monkeypatch):
    monkeypatch.setattr(evidence, "FOLDER", tmp_path / "evidence")
    found = evidence.table(("a", "b"), [(1, "x")])
    command = "python -m tests.faults --page"
    path = evidence.write_evidence("name", "A title", "\nWords.\n", [found], command)
    text = path.read_text("utf-8")
    assert text.startswith("# A title\n\nWords.\n\n| a | b |\n| --- | --- |\n| 1 | x |\n\n")
    assert module_of(ORIGIN.search(text)["command"]) == "tests.faults"
