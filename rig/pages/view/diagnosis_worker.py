"""The process in which the live page has a run diagnosed."""

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from can_dbc.errors import InputError
from rig.diagnosis.outcome import REPORT_FILE

_NICENESS = 19
"""The lowest priority: everything else on the machine goes first."""


class DiagnosisProgress(NamedTuple):
    """Progress of a diagnosis: the stage that is running, and the share that is done."""

    stage: str
    share: float


class DiagnosisFailure(NamedTuple):
    """Reason for which a diagnosis ended without a result."""

    reason: str


def run_diagnosis(
    run: Path, model: str, held_out: Sequence[Path], out: Path, reports: Connection
) -> None:
    """Diagnose a run with a model, by file or name, and write results and report into `out`.

    `reports` takes a `DiagnosisProgress` for each step, and a `DiagnosisFailure` at the end of a
    diagnosis that fails.
    """
    # Imported here: the server, which imports this module, needs none of it.
    from dart_model.spec import load_named_model
    from rig.diagnosis.files import diagnose_runs
    from rig.pages.report import write_report

    # Ctrl-C in the terminal reaches this process too; the server ends it in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)

    def send(message: DiagnosisProgress | DiagnosisFailure) -> None:
        with contextlib.suppress(OSError):  # a server that was killed reads no longer
            reports.send(message)

    try:
        result = diagnose_runs(
            [run],
            load_named_model(model, Path()),
            held_out,
            out,
            lambda stage, share: send(DiagnosisProgress(stage, share)),
        )
        write_report(result, out / REPORT_FILE)
    except (InputError, OSError) as error:
        send(DiagnosisFailure(str(error)))
        sys.exit(1)
    except Exception as error:
        send(DiagnosisFailure(f"{type(error).__name__}: {error}"))
        raise
