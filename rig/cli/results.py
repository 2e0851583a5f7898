"""What was found, as tables on the terminal."""

from typing import TYPE_CHECKING

from rig.cli.output import Outcome, console, table

if TYPE_CHECKING:
    from dart_model.spec import ModelSpec
    from rig.demo.cases import Case
    from rig.diagnosis.outcome import Diagnosis
    from rig.run.logged_run import Ended

_OF_TICKS = ("stale", "overruns", "limited", "bus_faulty", "left_out", "device_faulty")
"""Counts of ticks; the others are of frames."""


def print_case(case: "Case") -> None:
    """Print how far the model was from the bench, strut by strut."""
    for strut in case.struts:
        shown = table(
            "after the first 0.5 s",
            "model alone",
            "with virtual force",
            title=f"Bench and model, strut “{strut.name}”",
        )
        alone, observed = strut.figures(strut.defective), strut.figures(strut.observed)
        shown.add_row(
            "height error, largest",
            f"{alone.height_error_max_m * 1e3:.3f} mm",
            f"{observed.height_error_max_m * 1e3:.3f} mm",
        )
        for name, label in (("force_error_rms_n", "RMS"), ("force_error_max_n", "largest")):
            shown.add_row(
                f"force error, {label}",
                *(_share(getattr(item, name), item.force_peak_n) for item in (alone, observed)),
            )
        shown.add_row("force of the bench, peak", f"{alone.force_peak_n:.1f} N", "")
        console.print(shown)


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


def verdict(diagnosis: "Diagnosis", spec: "ModelSpec") -> list[Outcome]:
    """The verdict for a CI server: a model that lacks nothing passes."""
    from rig.pages.report import sentence

    is_right = diagnosis.verdict == "nothing_missing"
    text = sentence(diagnosis, len(spec.struts))
    return [Outcome("the model lacks nothing", f"{diagnosis.verdict}: {text}", not is_right)]


def _print_linear(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import linear

    if diagnosis.linear:
        shown = table(
            "linear correction", "nominal", "corrected", "95 % interval", "", title="Linear part"
        )
        for name, _, strut, *cells in linear(diagnosis):
            shown.add_row(f"{name} ({strut})" if struts > 1 else name, *cells)
        console.print(shown)


def _print_effects(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import effects, existing

    missing, changed = effects(diagnosis), existing(diagnosis)
    if missing:
        shown = table("effect", "parameter", "value", "95 % interval", title="What is missing")
        for law, _, rows in missing:
            for *_, value, interval, _, key in rows:
                shown.add_row(f"{law.family}: {law.name}", key, value, interval)
        console.print(shown)
    for law, note, rows in changed:
        values = [f"{key} {before} → {value}" for _, before, value, _, _, key in rows]
        console.print(f"- {law.name}, {'; '.join((note, *values))}", markup=False)


def _print_held_out(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import errors

    shown = table("on held-out data", "before", "after", "noise floor", title="RMS error")
    for name, before, after, _, floor, _ in errors(diagnosis):
        shown.add_row(name[:1].lower() + name[1:], before, after, floor)
    console.print(shown)


def _share(force_n: float, peak_n: float) -> str:
    return f"{force_n:.2f} N ({force_n / peak_n:.2%} of peak)"


def print_ended(ended: "Ended", *, with_timing: bool) -> None:
    """Print how a run ended."""
    shown = table("Run", f"{ended.ticks} ticks, ended {ended.state.mode.name}")
    for name, value in ended.state.counts._asdict().items():
        if value or name in ("lost", "refused", "overruns"):
            what = "ticks" if name in _OF_TICKS else "frames"
            shown.add_row(f"{name.replace('_', ' ')} ({what})", str(value))
    if with_timing:
        timing = ended.timing
        for label, figures in (("lateness", timing.lateness_us()), ("work", timing.work_us())):
            text = " · ".join(f"{level} {value:.0f}" for level, value in figures.items())
            shown.add_row(f"{label} of a tick, µs", text)
        shown.add_row("longest gap, µs", f"{timing.extremes_ns[2] / 1000:.0f}")
    if ended.diverged is not None:
        where = f"strut {ended.diverged['strut']} at {ended.diverged['t_s']:.3f} s"
        shown.add_row("model diverged", f"[red]{where}[/]")
    if ended.log_fault is not None:
        shown.add_row("log", f"[red]{ended.log_fault}[/]")
    console.print(shown)
    if with_timing:
        _draw_timing(ended)


def _draw_timing(ended: "Ended") -> None:
    from rig.pages.timing_picture import draw_run

    try:
        console.print(f"Histograms of lateness and work: {draw_run(ended)}", markup=False)
    except OSError as error:  # a disk that is full takes no picture, and the run is over anyway
        console.print(f"No histograms: {error.strerror}", style="yellow")
