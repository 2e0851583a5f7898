"""The tour in the README, line by line."""

import re
import shlex
import sys
from pathlib import Path

import pytest

from rig.cli.main import main

README = Path(__file__).parents[2] / "README.md"


def blocks():
    """Indented blocks of the section: the commands, and the Python."""
    section = README.read_text("utf-8").partition("\n## A tour\n")[2].partition("\n## ")[0]
    found = re.findall(r"(?:^    .*\n)+", section, re.MULTILINE)
    assert len(found) == 2
    return [[line[4:] for line in block.splitlines()] for block in found]


@pytest.mark.long
def test_the_tour_is_walked_as_it_stands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    commands, script = blocks()
    for line in commands:
        words = shlex.split(line)
        assert words[0] == "rig"
        monkeypatch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0, line
    assert (tmp_path / "tour" / "run.html").exists()
    assert list((tmp_path / "tour" / "parquet").iterdir())
    capsys.readouterr()
    exec("\n".join(script), {})
    lacked, found = capsys.readouterr().out.splitlines()
    assert float(lacked.split()[0]) > 5.0
    assert found == "cubic_stiffness is what the diagnosis found"
