"""Help comes at once, and names the choices that there are."""

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.demo.cases import CASES
from rig.formats.export import FORMATS

SLOW = ("asammdf", "can", "dartpy", "matplotlib", "numba", "numpy", "pyarrow", "scipy")
"""What takes long to import; together seconds."""

HELP = """
import sys
from rig.cli.main import main
try:
    main()
except SystemExit as ended:
    assert ended.code == 0
print("imported:", *sys.modules)
"""


@pytest.mark.parametrize("command", [[], ["demo"], ["run"], ["diagnose"], ["export"]])
def test_help_imports_nothing_slow(command: list[str]) -> None:
    arguments = [sys.executable, "-c", HELP, *command, "--help"]
    shown = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    imported = shown.rpartition("imported:")[2].split()
    assert "typer" in imported
    assert not set(SLOW).intersection(imported)


@pytest.mark.parametrize(("command", "choices"), [("demo", CASES), ("export", FORMATS)])
def test_help_names_every_choice(command: str, choices: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200"}).output
    for choice in choices:
        assert choice in shown


@pytest.mark.parametrize("command", [[], ["sensor"]])
def test_a_name_alone_shows_help(command: list[str]) -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "rig", *command], capture_output=True, text=True, check=True
    )
    assert "Usage" in shown.stdout
    assert not shown.stderr
