"""Pages of the guide that hold measured tables: each is written by the program that measured it.

A page is one file under `rig/guide/pages/evidence`. Its command, date, version and machine stand in
it, so that a reader can repeat it; no figure is typed.
"""

import argparse
import datetime
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from rig.guide.site import PAGES
from rig.machine.installed_versions import version_of

FOLDER = PAGES / "evidence"


PAGE_HELP = "write the guide's page of evidence"
"""Help of the option `--page`, by which a program writes its page."""


def add_page_option(parser: argparse.ArgumentParser) -> None:
    """Give a program the option `--page`."""
    parser.add_argument("--page", action="store_true", help=PAGE_HELP)


def command_line() -> str:
    """The command that started this program, as a shell takes it."""
    spec = sys.modules["__main__"].__spec__
    module = spec.name.removesuffix(".__main__") if spec else sys.argv[0]
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def write_evidence(
    name: str,
    title: str,
    text: str,
    tables: Sequence[str],
    command: str,
    *,
    with_load: bool = True,
) -> Path:
    """Write a page of the guide; returns its file.

    Args:
        name: Of the file, without its suffix.
        title: The page's title.
        text: What was measured, and how, in Markdown.
        tables: Tables and sentences that hold the figures, in Markdown.
        command: What measured them.
        with_load: Whether the machine's load matters, because the figures contain times.
    """
    path = FOLDER / f"{name}.md"
    path.parent.mkdir(exist_ok=True)
    parts = [
        f"# {title}",
        text.strip(),
        *tables,
        f"Measured with\n\n    {command}\n\n{_origin(with_load)}",
    ]
    path.write_text("\n\n".join(parts) + "\n", "utf-8")
    return path


def _origin(with_load: bool) -> str:
    commit = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"],
        capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    packages = ", ".join(f"{name} {version_of(name)}" for name in ("dartpy", "numpy", "python-can"))
    load = f", 15-minute load average {os.getloadavg()[2]:.1f}" if with_load else ""
    return (
        f"on {today}, rig {version_of('rig')} (commit {commit or 'unknown'}), Python "
        f"{'.'.join(map(str, sys.version_info[:3]))}, {packages}, {platform.system()} on "
        f"{os.cpu_count()} cores{load}."
    )
