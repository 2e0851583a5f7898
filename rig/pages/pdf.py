"""A page on paper: printed by the browser that is there."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from can_dbc.errors import InputError

_BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
    "msedge",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)

_LONGEST_S = 120.0
"""Time after which a browser that prints nothing is taken for stuck; it takes seconds."""


def browser() -> str:
    """The browser that prints.

    Raises:
        InputError: There is none.
    """
    found = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise InputError("--pdf: expected Chromium, Chrome or Edge on this machine to print with")
    return found


def print_page(page: Path, pdf: Path) -> None:
    """Print a page that needs no network.

    Args:
        page: HTML file.
        pdf: File to write.

    Raises:
        InputError: There is no browser, it fails, or the file cannot be written.
    """
    program = browser()
    # Its children may still write into it when it is gone.
    place = tempfile.TemporaryDirectory(prefix="rig-print-", ignore_cleanup_errors=True)
    with place as profile:
        command = [
            program,
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
            f"--print-to-pdf={pdf.absolute()}",
            # Chromium's sandbox refuses to run as root.
            *(["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []),
            page.absolute().as_uri(),
        ]
        try:
            ended = subprocess.run(command, capture_output=True, timeout=_LONGEST_S, check=False)  # noqa: S603 - a browser, and a page of ours
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"{pdf}: {program} did not print it: {error}") from error
    if ended.returncode != 0 or not pdf.exists():
        said = ended.stderr.decode("utf-8", "replace").strip().splitlines()
        why = said[-1][:200] if said else f"exit code {ended.returncode}"
        raise InputError(f"{pdf}: {program} did not print it: {why}")
