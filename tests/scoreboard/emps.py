"""EMPS: a carriage on a ball screw under a position controller, a stage without a spring.

References:
    Janot, Gautier, Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks (2019): mass, damping, friction.
    Forgione, Piga, "dynoNet: a neural network architecture for learning dynamical systems", Int. J.
    Adapt. Control Signal Process. 35 (2021): a model without physics.
"""

from pathlib import Path

from rig.diagnosis.files import diagnose_runs
from rig.diagnosis.progress import Progress, within
from rig.pages.report import write_report
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from tests.scoreboard.emps_friction import friction_rows
from tests.scoreboard.starts import one_body
from tests.scoreboard.table import CORRECTED, START, Row, findings

_NAME, _UNIT = "EMPS", "RMSE of the position in free-run simulation, mm"
_RUNS = ("train", "pulses")
_MIDDLE_M = 0.5
"""Offset of the heights; without a spring any free length would do."""
_MASS_KG, _DAMPING_N_S_PER_M = 95.1, 203.5
"""As Janot et al. published them."""
_MM_PER_M = 1000.0


def emps_rows(data_folder: Path | None, out: Path, progress: Progress) -> list[Row]:
    """Free-run error of either run, learnt from the other, and what each says about friction.

    None without the set.
    """
    if data_folder is None:
        return []
    files = {name: data_folder / "emps" / f"{name}.csv" for name in _RUNS}
    if not all(path.is_file() for path in files.values()):
        return []
    rows = [Row(_NAME, "pulses", "dynoNet", 2.64, _UNIT, "Forgione, Piga 2021")]
    model = one_body(_NAME, (_MASS_KG, _DAMPING_N_S_PER_M, 0.0), _MIDDLE_M)
    for i, (learnt, test) in enumerate((_RUNS, _RUNS[::-1])):
        share = within(progress, 0.5 * i, 0.5 * (i + 1), f"{_NAME}, {test}")
        folder = out / "emps" / test
        try:
            result = diagnose_runs([files[learnt]], model, [files[test]], folder, share)
        except RecordingError as error:
            why = f"computed here, trained on `{learnt}`; refused: {error}"
            rows.append(Row(_NAME, test, CORRECTED, None, _UNIT, why))
            continue
        write_report(result, folder / "report.html")
        error = result.diagnosis.held_out.height_rmse_m
        start = "computed here; start model with published mass and damping, no friction"
        rows.append(Row(_NAME, test, START, _MM_PER_M * error.before, _UNIT, start))
        how = f"computed here, trained on `{learnt}`; {findings(result.diagnosis)}"
        rows.append(Row(_NAME, test, CORRECTED, _MM_PER_M * error.after, _UNIT, how))
    progress(f"{_NAME}: friction that each recording asks for", 1.0)
    strut = [model.struts[0].name]
    return rows + friction_rows({name: read_recording(files[name], strut) for name in _RUNS})
