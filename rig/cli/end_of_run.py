"""The end of a run on the terminal: summary, table, exit code, the next command."""

import contextlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console

from can_dbc.errors import InputError
from rig.cli.result_tables import print_run
from rig.cli.terminal import FAILED, print_text

if TYPE_CHECKING:
    from rig.plan.plan import Plan
    from rig.recordings.gaps import Gaps
    from rig.run.logged_run import Ended

_LONGEST_READ_S = 120.0
"""Longest run that is read again at its end, which takes about 4 % of its duration."""


_LITTLE_VALID = 0.5
"""Share of valid ticks below which a run is remarked on."""


def _is_long(ended: "Ended") -> bool:
    """Whether a run is too long to be read again at its end."""
    return ended.ticks * ended.period_ns > _LONGEST_READ_S * 1e9


def _summary_text(ended: "Ended") -> str:
    return json.dumps(ended.summary(), indent=2) + "\n"


def keep_summary(ended: "Ended", folder: Path) -> None:
    """Write `summary.json` into a run's folder."""
    with contextlib.suppress(OSError):  # a full disk, which the table reports
        (folder / "summary.json").write_text(_summary_text(ended), "utf-8")


def print_end(
    plan: "Plan",
    ended: "Ended",
    folder: Path,
    following: str,
    *,
    with_timing: bool,
    as_json: bool,
) -> None:
    """Print how a run ended, refuse a bad end with its exit code, and name what follows.

    As JSON, nothing but its summary is printed.
    """
    if as_json:
        typer.echo(_summary_text(ended), nl=False)
        _refuse_bad_end(plan, ended, folder)
        return
    print_run(ended, with_timing=with_timing)
    print_text(f"Run: {folder}")
    _refuse_bad_end(plan, ended, folder)
    if plan.has_force and (gaps := _gaps_of(ended, folder)) is not None:
        print_text(gaps.report(folder.name), "yellow")
    _print_validity(ended)
    _print_stated_std(plan, ended, folder)
    if following:
        print_text(f"Next: `{following}`")
    if following.startswith("rig diagnose"):
        print_text(
            "A second run of another motion, given with --held-out, evaluates the correction; "
            "without one, parts of this run do."
        )


def diagnosis_of(plan: "Plan", folder: Path, model: str | None = None) -> str:
    """The command that follows a run; empty where no force was measured.

    It diagnoses the run with the model that it used, or evaluates one that is already corrected.
    """
    from rig.diagnosis.outcome import DIAGNOSIS_FILE

    if not plan.has_force:
        return ""
    used = model or _model_of(plan)
    if (Path(used).parent / DIAGNOSIS_FILE).is_file():
        return f"rig evaluate {folder} --model {used}"
    names = ("found", *(f"found_{number}" for number in range(2, 100)))
    out = next((name for name in names if not Path(name).exists()), names[-1])
    return f"rig diagnose {folder} --model {used} --out {out}"


def _model_of(plan: "Plan") -> str:
    """The configuration's model: its name, or its file as seen from the current folder."""
    file = plan.source.parent / plan.config.model
    return os.path.relpath(file) if file.is_file() else plan.config.model


def _print_validity(ended: "Ended") -> None:
    """Print that an estimate was invalid for most of a run, and what to look at."""
    from rig.bridge.values import Mode

    share = ended.ticks_in_mode.get(Mode.RUNNING, 0) / max(sum(ended.ticks_in_mode.values()), 1)
    if share < _LITTLE_VALID:
        print_text(
            f"The estimate was valid in only {share:.0%} of the ticks; events.jsonl has the "
            "causes. If it is unsettled again and again, the loop is not stable in this motion: "
            "`rig check` and `rig tune` examine that.",
            "yellow",
        )


def _print_stated_std(plan: "Plan", ended: "Ended", folder: Path) -> None:
    """Print the standard deviation that observers stated of valid estimates of a run."""
    import numpy as np

    from rig.log.errors import LogError
    from rig.log.reader import read_run

    stating = [it.name for it in plan.struts if it.observer.knows_std]
    if not stating or _is_long(ended):
        return
    try:
        steps = read_run(folder).steps
    except LogError:
        return
    for name in stating:
        std_n = steps.column(f"{name}.force_std_n").to_numpy()
        std_n = std_n[(steps.column(f"{name}.valid").to_numpy() == 1.0) & np.isfinite(std_n)]
        if len(std_n):
            median_n, most_n = np.quantile(std_n, [0.5, 0.99])
            print_text(
                f"Standard deviation that the observer of {name} stated while valid: median "
                f"{median_n:.3g} N, at most {most_n:.3g} N in 99 % of the ticks. A limit on "
                "force_std_n below that makes usual estimates invalid."
            )


def _gaps_of(ended: "Ended", folder: Path) -> "Gaps | None":
    """Gaps of the applied force in a run in which something was missing."""
    from rig.recordings.run_folder import read_run

    counts = ended.state.counts
    is_whole = not (counts.lost or counts.refused or counts.stale or counts.overruns)
    if is_whole or _is_long(ended):
        return None
    with contextlib.suppress(InputError):  # `rig diagnose` reports what is wrong with a recording
        return read_run(folder).gaps
    return None


def _describe_heights(plan: "Plan", ended: "Ended", folder: Path) -> str:
    """What arrived of each height in a run that did not start, a line for each."""
    from rig.log.reader import read_run
    from rig.recordings.run_folder import read_channel
    from rig.sensors.mounting import describe_arrivals

    if _is_long(ended):
        return ""
    with contextlib.suppress(InputError):  # nothing was logged
        run = read_run(folder)
        return "".join(
            f"\n{height.key}: {describe_arrivals(run, height, read_channel(run, height)[0])}"
            for height in plan.heights
        )
    return ""


def _refuse_bad_end(plan: "Plan", ended: "Ended", folder: Path) -> None:
    """Exit with a message where a run ended in its safe state, without a height or without a log.

    Raises:
        Exit: It did.
    """
    from rig.bridge.values import Mode

    stderr = Console(stderr=True)
    if ended.state.mode is Mode.WAITING:
        heights = _describe_heights(plan, ended, folder)
        stderr.print(
            f"The model did not start: no valid height arrived.{heights}",
            style="red",
            highlight=False,
            soft_wrap=True,
        )
        raise typer.Exit(FAILED)
    if ended.state.mode is Mode.SAFE:
        stderr.print(f"The run ended in its safe state{_why(ended)}.", style="red")
        raise typer.Exit(FAILED)
    if ended.dropped_steps:
        stderr.print(
            f"The log lacks {ended.dropped_steps} ticks ({ended.log_fault}): expected a disk with "
            "room, and fast enough.",
            style="red",
        )
        raise typer.Exit(FAILED)


def _why(ended: "Ended") -> str:
    """When and why a run entered its safe state, as the end of a phrase."""
    from rig.pages.mode_words import describe_cause

    if not ended.cause:
        return ""
    since_s = ended.cause.get("t_s")
    at = f" at {since_s:.1f} s" if isinstance(since_s, float) else ""
    return f"{at}: {describe_cause(ended.cause)} (events.jsonl has what led there)"
