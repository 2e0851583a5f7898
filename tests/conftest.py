"""What holds for all tests."""

import os
import zlib

# Two workers on two cores: with threads in each, linear algebra takes five times as long. numpy
# reads the variable when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from tests.foreign_modules import ForeignModules

# A busy machine is no fault of what is tested, and every day draws the same examples.
settings.register_profile("patient", deadline=None, derandomize=True)
settings.load_profile("patient")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--part 1/2`: one half of the tests; `--part 0/2` is the other."""
    parser.addoption("--part", default="0/1", metavar="K/N", help="the tests of part K of N")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep a part of the tests, by their names: which ones does not depend on the others."""
    part, parts = map(int, config.getoption("--part").split("/"))
    kept = [item for item in items if zlib.crc32(item.nodeid.encode()) % parts == part]
    if len(kept) < len(items):
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept


@pytest.fixture
def foreign_modules(tmp_path, monkeypatch):
    """The working directory: a folder with modules that no process of rig may import."""
    modules = ForeignModules(tmp_path / "working_directory")
    monkeypatch.chdir(modules.folder)
    monkeypatch.setenv("PYTHONSAFEPATH", "")  # as if it were not set; restored after the test
    return modules
