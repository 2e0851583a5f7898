"""The C of an FMU, compiled for this system and for others, with the compiler of `ziglang`."""

import importlib.util
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from can_dbc.errors import InputError, missing_package
from rig.fmu.source import select_c_files
from rig.machine.child_processes import PYTHON


class Target(NamedTuple):
    """A system that an FMU runs on.

    Attributes:
        triple: Its name for the compiler, with the oldest C library of Linux that is still in use.
        fmi_2: Its folder in an FMU of FMI 2.0, or None where that has no name for it.
        fmi_3: The same of FMI 3.0.
    """

    words: str
    triple: str
    fmi_2: str | None
    fmi_3: str
    suffix: str

    def folder(self, version: str) -> str | None:
        """Its folder in an FMU of a version of the interface."""
        return self.fmi_2 if version == "2.0" else self.fmi_3


TARGETS = (
    Target("Linux", "x86_64-linux-gnu.2.17", "linux64", "x86_64-linux", ".so"),
    Target("Linux on ARM", "aarch64-linux-gnu.2.17", None, "aarch64-linux", ".so"),
    Target("Windows", "x86_64-windows-gnu", "win64", "x86_64-windows", ".dll"),
    Target("macOS", "x86_64-macos", "darwin64", "x86_64-darwin", ".dylib"),
    Target("macOS on ARM", "aarch64-macos", None, "aarch64-darwin", ".dylib"),
)

# No contraction: one rounding for a product and a sum would not be what Python computes.
_FLAGS = (
    "-DFMI2_OVERRIDE_FUNCTION_PREFIX",
    "-DFMI3_OVERRIDE_FUNCTION_PREFIX",
    "-std=c99",
    "-O2",
    "-ffp-contract=off",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
)
_TIMEOUT_S = 1200.0
"""Time that a compiler may take: far longer than one needs, so that one that hangs is ended."""


def compile_for(
    targets: Iterable[Target],
    sources: dict[str, str],
    identifier: str,
    done: Callable[[Target], None] = lambda _: None,
) -> dict[Target, bytes]:
    """Shared libraries, compiled from C files by their names, for each target.

    `identifier` is a library's name without its suffix; `done` is called after each system.

    Raises:
        InputError: The package `ziglang` is not installed, or its compiler refuses.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise InputError(missing_package("ziglang, a C compiler,", "pip install -e '.[fmu]'"))
    libraries: dict[Target, bytes] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        for target in targets:
            out = folder / target.fmi_3 / f"{identifier}{target.suffix}"
            out.parent.mkdir()
            _compile(folder, select_c_files(sources), target, out)
            libraries[target] = out.read_bytes()
            done(target)
    return libraries


def _compile(folder: Path, files: list[str], target: Target, out: Path) -> None:
    compiler = [*PYTHON, "-m", "ziglang", "cc", "-target", target.triple]
    linked = ["-s", "-lm"] if target.suffix == ".so" else ["-s"]
    shared = ["-shared", "-fPIC"] if target.suffix != ".dll" else ["-shared"]
    command = [*compiler, *_FLAGS, *shared, "-o", str(out), *files, *linked]
    result = subprocess.run(  # noqa: S603  # a list, no shell
        command, cwd=folder, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
    )
    if result.returncode != 0:
        first = next((line for line in result.stderr.splitlines() if "error" in line), "no reason")
        raise InputError(f"the C compiler for {target.words}: {first}")
