"""Results of runs and diagnoses as tables on the terminal."""

from typing import TYPE_CHECKING

from rig.cli.junit import Outcome
from rig.cli.terminal import console, table

if TYPE_CHECKING:
    from dart_model.spec import ModelSpec
    from rig.demo.cases import Case
    from rig.diagnosis.outcome import Diagnosis
    from rig.run.logged_run import Ended

_OF_TICKS = ("stale", "overruns", "limited", "bus_faulty", "left_out", "device_faulty")
"""Counts of ticks; the others are of frames."""


def print_case(case: "Case") -> None:
    """Print the deviation of the model from the bench for each strut."""
    for strut in case.struts:
        rows = table(
            "after the first 0.5 s",
            "model alone",
            "with virtual force",
            title=f"Bench and model, strut “{strut.name}”",
        )
        alone, observed = strut.figures(strut.defective), strut.figures(strut.observed)
        rows.add_row(
            "height error, largest",
            f"{alone.height_error_max_m * 1e3:.3f} mm",
            f"{observed.height_error_max_m * 1e3:.3f} mm",
        )
        for name, label in (("force_error_rms_n", "RMS"), ("force_error_max_n", "largest")):
            rows.add_row(
                f"force error, {label}",
                *(
                    _force_and_share(getattr(item, name), item.force_peak_n)
                    for item in (alone, observed)
                ),
            )
        rows.add_row("force of the bench, peak", f"{alone.force_peak_n:.1f} N", "")
        console.print(rows)


def print_diagnosis(diagnosis: "Diagnosis", *, struts: int) -> None:
    """Print a diagnosis; `struts` is how many the model has."""
    from rig.pages.report import sentence

    console.print(f"\n[bold]{diagnosis.verdict.replace('_', ' ')}[/]: ", end="")
    console.print(sentence(diagnosis, struts), markup=False)
    _print_linear(diagnosis, struts=struts)
    _print_effects(diagnosis)
    _print_held_out(diagnosis)
    for note in diagnosis.notes:
        console.print(f"- {note}", markup=False)


def diagnosis_check(diagnosis: "Diagnosis", spec: "ModelSpec") -> list[Outcome]:
    """Check for a CI server that a model lacks nothing."""
    from rig.pages.report import sentence

    is_complete = diagnosis.verdict == "nothing_missing"
    text = sentence(diagnosis, len(spec.struts))
    return [Outcome("the model lacks nothing", f"{diagnosis.verdict}: {text}", not is_complete)]


def _print_linear(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import linear

    if diagnosis.linear:
        rows = table(
            "linear correction", "nominal", "corrected", "95 % interval", "", title="Linear part"
        )
        for name, _, strut, *cells in linear(diagnosis):
            rows.add_row(f"{name} ({strut})" if struts > 1 else name, *cells)
        console.print(rows)


def _print_effects(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import effects, existing

    missing, changed = effects(diagnosis), existing(diagnosis)
    if missing:
        rows = table("effect", "parameter", "value", "95 % interval", title="Missing effects")
        for law, _, parameters in missing:
            for *_, value, interval, _, key in parameters:
                rows.add_row(f"{law.family}: {law.name}", key, value, interval)
        console.print(rows)
    for law, note, parameters in changed:
        values = [f"{key} {before} → {value}" for _, before, value, _, _, key in parameters]
        console.print(f"- {law.name}, {'; '.join((note, *values))}", markup=False)


def _print_held_out(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import errors

    rows = table("on held-out data", "before", "after", "noise floor", title="RMS error")
    for name, before, after, _, floor, _ in errors(diagnosis):
        rows.add_row(name[:1].lower() + name[1:], before, after, floor)
    console.print(rows)


def _force_and_share(force_n: float, peak_n: float) -> str:
    return f"{force_n:.2f} N ({force_n / peak_n:.2%} of peak)"


def print_run(ended: "Ended", *, with_timing: bool) -> None:
    """Print how a run ended."""
    rows = table("Run", f"{ended.ticks} ticks, ended {ended.state.mode.name}")
    for name, value in ended.state.counts._asdict().items():
        if value or name in ("lost", "refused", "overruns"):
            what = "ticks" if name in _OF_TICKS else "frames"
            rows.add_row(f"{name.replace('_', ' ')} ({what})", str(value))
    if with_timing:
        timing = ended.timing
        for label, figures in (("lateness", timing.lateness_us()), ("work", timing.work_us())):
            text = " · ".join(f"{level} {value:.0f}" for level, value in figures.items())
            rows.add_row(f"{label} of a tick, µs", text)
        rows.add_row("longest gap, µs", f"{timing.extremes_ns[2] / 1000:.0f}")
    if ended.diverged is not None:
        where = f"strut {ended.diverged['strut']} at {ended.diverged['t_s']:.3f} s"
        rows.add_row("model diverged", f"[red]{where}[/]")
    if ended.log_fault is not None:
        rows.add_row("log", f"[red]{ended.log_fault}[/]")
    console.print(rows)
    if with_timing:
        _print_timing_picture(ended)


def _print_timing_picture(ended: "Ended") -> None:
    from rig.pages.timing_picture import draw_run

    try:
        console.print(f"Histograms of lateness and work: {draw_run(ended)}", markup=False)
    except OSError as error:  # such as a full disk; the run is over and its log is whole
        console.print(f"No histograms: {error.strerror}", style="yellow")
