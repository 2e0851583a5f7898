"""Prints a page to PDF with an installed browser."""

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
"""Time after which a browser that prints nothing is ended; printing takes seconds."""


def find_browser() -> str:
    """Program of a browser that can print.

    Raises:
        InputError: None is installed.
    """
    program = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if program is None:
        raise InputError("--pdf: expected Chromium, Chrome or Edge on this machine to print with")
    return program


def print_page(page: Path, pdf: Path) -> None:
    """Print an HTML page, which needs no network, to a PDF file.

    Raises:
        InputError: No browser is installed, it fails, or the file cannot be written.
    """
    program = find_browser()
    # Child processes of the browser may still write into it after the browser has ended.
    folder = tempfile.TemporaryDirectory(prefix="rig-print-", ignore_cleanup_errors=True)
    with folder as profile:
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
            process = subprocess.run(command, capture_output=True, timeout=_LONGEST_S, check=False)  # noqa: S603 - a browser, and a page of ours
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"{pdf}: {program} did not print it: {error}") from error
    if process.returncode != 0 or not pdf.exists():
        lines = process.stderr.decode("utf-8", "replace").strip().splitlines()
        why = lines[-1][:200] if lines else f"exit code {process.returncode}"
        raise InputError(f"{pdf}: {program} did not print it: {why}")
