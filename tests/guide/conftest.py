"""The site, built once."""

import sys

import pytest

from rig.cli.main import main


def build_by_command(folder, monkeypatch):
    """Build the site by `rig docs`; returns the exit code."""
    monkeypatch.setattr(sys, "argv", ["rig", "docs", str(folder)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The site, which is built strictly: a link or an anchor that leads nowhere is an error."""
    folder = tmp_path_factory.mktemp("guide") / "site"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert build_by_command(folder, monkeypatch) == 0
    return folder
