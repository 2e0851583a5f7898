"""What holds for all tests."""

import os

# Two workers on two cores: with threads in each, linear algebra takes five times as long. numpy
# reads the variable when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

from tests.foreign_modules import ForeignModules

# A busy machine is no fault of what is tested, and every day draws the same examples.
settings.register_profile("patient", deadline=None, derandomize=True)
settings.load_profile("patient")


@pytest.fixture
def foreign_modules(tmp_path, monkeypatch):
    """The working directory: a folder with modules that no process of rig may import."""
    modules = ForeignModules(tmp_path / "working_directory")
    monkeypatch.chdir(modules.folder)
    monkeypatch.setenv("PYTHONSAFEPATH", "")  # as if it were not set; restored after the test
    return modules
