"""Several bridges on one machine: a process each, since each has a tick to keep."""

import contextlib
import ctypes
import json
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import TypedDict

from rich.markup import escape

from can_dbc.errors import InputError
from rig.cli.progress import handle_signals
from rig.cli.terminal import FAILED, OK, WRONG_INPUT, print_json, print_table
from rig.files.folders import refuse_full
from rig.machine.child_processes import PYTHON

_PR_SET_PDEATHSIG = 1
"""Of linux/prctl.h: which signal a process is sent when its parent dies; see prctl(2)."""

_WORST = (WRONG_INPUT, FAILED)
"""Exit codes that others give way to, the worst first."""


def run_side_by_side(
    configs: Sequence[Path], folder: Path, options: Sequence[str], *, as_json: bool
) -> int:
    """Run a bridge for each configuration, each with the options; returns the worst exit code.

    What each says is shown behind its name. Ctrl-C ends all in order; one that ends, however it
    does, ends no other. Each has a folder in `folder`, called as its configuration.

    Raises:
        InputError: Two of them have one name, or a folder is not empty.
    """
    names = [config.stem for config in configs]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(
            f"{twice[0]}: two configurations of this name, or one twice; expected different names"
        )
    for name in names:
        refuse_full(folder / name)
    bridges: dict[str, subprocess.Popen[str]] = {}
    readers: list[threading.Thread] = []
    with _end_together(bridges):
        for name, config in zip(names, configs, strict=True):
            bridges[name] = _start(config, folder / name, options)
        for item in bridges.items():
            readers.append(threading.Thread(target=_pass_on, args=item, daemon=True))
            readers[-1].start()
        ends = {name: bridge.wait() for name, bridge in bridges.items()}
    for reader in readers:
        reader.join()
    # A program which a signal ended has failed.
    codes = {name: FAILED if code < 0 else code for name, code in ends.items()}
    summaries = {name: _summary(folder / name) for name in names}
    if as_json:
        print_json({name: {"exit_code": codes[name], **summaries[name]} for name in names})
    else:
        _print(codes, summaries, folder)
    return next(
        (code for code in _WORST if code in codes.values()), max(codes.values(), default=OK)
    )


def _start(config: Path, folder: Path, options: Sequence[str]) -> "subprocess.Popen[str]":
    command = [*PYTHON, "-m", "rig", "run", str(config), "--out", str(folder), *options]
    # A separate session: the terminal's Ctrl-C comes here, and is passed on once.
    return subprocess.Popen(  # noqa: S603  # a list, no shell
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=_ends_with_its_parent if sys.platform == "linux" else None,  # noqa: PLW1509
    )


def _ends_with_its_parent() -> None:
    """Ctrl-C from the kernel, should the parent die without a word; no thread runs there yet."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


def _pass_on(name: str, bridge: "subprocess.Popen[str]") -> None:
    """What a bridge says, behind its name, on standard error."""
    for line in bridge.stdout or ():
        sys.stderr.write(f"{name}: {line}")


@contextlib.contextmanager
def _end_together(bridges: Mapping[str, "subprocess.Popen[str]"]) -> Generator[None]:
    """Ctrl-C, an end that is asked for and a closed terminal go to every bridge, and an error."""

    def forward(_number: int, _frame: FrameType | None) -> None:
        for bridge in list(bridges.values()):
            if bridge.poll() is None:
                bridge.send_signal(signal.SIGINT)

    closed_terminal = [signal.SIGHUP] if sys.platform != "win32" else []
    with handle_signals(forward, signal.SIGINT, signal.SIGTERM, *closed_terminal):
        try:
            yield
        except BaseException:
            forward(0, None)
            raise


class _Summary(TypedDict, total=False):
    """What is shown of the summary of a run."""

    mode: str
    ticks: int
    counts: dict[str, int]


def _summary(folder: Path) -> _Summary:
    try:
        return json.loads((folder / "summary.json").read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def _print(codes: dict[str, int], summaries: dict[str, _Summary], folder: Path) -> None:
    rows: list[tuple[str, ...]] = []
    for name, code in codes.items():
        summary = summaries[name]
        words = "in order" if code == OK else f"exit code {code}"
        end = f"{words} {summary.get('mode', '')}".strip()
        missed = str(summary.get("counts", {}).get("overruns", ""))
        ticks = str(summary.get("ticks", ""))
        rows.append((escape(name), end, ticks, missed, escape(str(folder / name))))
    print_table(("bridge", "ended", "ticks", "missed", "run"), rows)
