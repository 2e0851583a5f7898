"""Results of runs and diagnoses as tables on the terminal."""

from typing import TYPE_CHECKING

from rich.text import Text

from rig.cli.junit import Outcome
from rig.cli.terminal import console, print_table, print_text, styled

if TYPE_CHECKING:
    from dart_model.spec import ModelSpec
    from rig.demo.cases import Case
    from rig.diagnosis.outcome import Diagnosis
    from rig.run.logged_run import Ended

_IN_OWN_ROW = ("overruns", "refused")
"""Counts that have a row of the table of a run already."""


def print_case(case: "Case") -> None:
    """Print the deviation of the model from the bench for each strut."""
    for strut in case.struts:
        both = strut.figures(strut.defective), strut.figures(strut.observed)
        peak_n = both[0].force_peak_n
        rows = [("height error, largest", *(f"{i.height_error_max_m * 1e3:.3f} mm" for i in both))]
        for name, label in (("force_error_rms_n", "RMS"), ("force_error_max_n", "largest")):
            forces_n = [getattr(item, name) for item in both]
            cells = (f"{force:.2f} N ({force / peak_n:.2%} of peak)" for force in forces_n)
            rows.append((f"force error, {label}", *cells))
        rows.append(("force of the bench, peak", f"{peak_n:.1f} N", ""))
        heads = ("after the first 0.5 s", "model alone", "with virtual force")
        print_table(heads, rows, f"Bench and model, strut “{strut.name}”")


def print_diagnosis(diagnosis: "Diagnosis", *, struts: int) -> None:
    """Print a diagnosis; `struts` is how many the model has."""
    from rig.pages.report import sentence

    console.print()
    console.print(styled(diagnosis.verdict.replace("_", " "), "bold"), end=": ")
    print_text(sentence(diagnosis, struts))
    _print_linear(diagnosis, struts=struts)
    _print_channels(diagnosis)
    _print_effects(diagnosis, struts=struts)
    _print_damper(diagnosis, struts=struts)
    _print_held_out(diagnosis)
    for note in diagnosis.notes:
        print_text(f"- {note}")


def diagnosis_check(diagnosis: "Diagnosis", spec: "ModelSpec") -> list[Outcome]:
    """Check for a CI server that a model lacks nothing."""
    from rig.pages.report import sentence

    is_complete = diagnosis.verdict == "nothing_missing"
    text = sentence(diagnosis, len(spec.struts))
    return [Outcome("the model lacks nothing", f"{diagnosis.verdict}: {text}", not is_complete)]


def _print_linear(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import linear

    if diagnosis.linear:
        heads = ("linear correction", "nominal", "corrected", "95 % interval", "")
        rows = [
            (f"{name} ({strut})" if struts > 1 else name, *cells)
            for name, _, strut, *cells in linear(diagnosis)
        ]
        title = "Linear part" + ", to which the effects add" * bool(diagnosis.effects)
        print_table(heads, rows, title)


def _print_channels(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import channels
    from rig.pages.report.words import reference_channel

    if rows := [(f"{name} {key}", *cells) for name, key, *cells in channels(diagnosis)]:
        heads = ("channel", "as recorded", "by the data", "95 % interval")
        print_table(heads, rows, f"Channels, against {reference_channel(diagnosis)}")


def _print_effects(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import effects, existing
    from rig.pages.report.words import acting_words, evidence_words, missing

    laws, changed = effects(diagnosis), existing(diagnosis)
    if laws:
        rows: list[tuple[str | Text, str, str]] = []
        for found, (law, _, parameters) in zip(missing(diagnosis), laws, strict=True):
            name = f"{law.name} ({found.strut})" if struts > 1 else law.name
            rows.append((styled(name, "bold"), "", ""))
            rows += [(f"  {row[0]}", row[2], row[3]) for row in parameters]
        print_table(("effect", "value", "95 % interval"), rows, "Missing effects")
        for found in missing(diagnosis):
            if found.evidence is not None:
                print_text(f"- {found.name}: {evidence_words(found.evidence, diagnosis.level)}.")
            if found.where is not None:
                print_text(f"- {found.name}: {acting_words(found.where)}.")
    for law, note, parameters in changed:
        values = [f"{key} {before} → {value}" for _, before, value, _, _, key in parameters]
        print_text(f"- {law.name}, {'; '.join((note, *values))}")


def _print_damper(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import damper

    if rows := damper(diagnosis):
        heads = ("at", "force", "95 % interval", "slope")
        named = [
            (f"{at} ({strut})" if struts > 1 else at, *cells[:3]) for strut, at, *cells in rows
        ]
        print_table(heads, named, "Corrected damper, without spring, friction and stops")


def _print_held_out(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import errors

    rows = [
        (name[:1].lower() + name[1:], before, linear, after, floor)
        for name, before, linear, after, _, floor, _ in errors(diagnosis)
    ]
    heads = ("on held-out data", "before", "best linear model", "after", "noise floor")
    print_table(heads, rows, "RMS error")


def _modes(ended: "Ended") -> str:
    """Share of a run's ticks in each mode."""
    ticks = {mode: n for mode, n in ended.ticks_in_mode.items() if n}
    shares = ((mode.name, n / max(sum(ticks.values()), 1)) for mode, n in ticks.items())
    ordered = sorted(shares, key=lambda item: -item[1])
    return " · ".join(f"{name} {100.0 * share:.1f} %" for name, share in ordered)


def print_run(ended: "Ended", *, with_timing: bool) -> None:
    """Print how a run ended."""
    from rig.pages.mode_words import COUNT_WORDS

    counts = ended.state.counts
    missed = f"{counts.overruns}"
    if counts.overruns:
        missed += f" ({100.0 * counts.overruns / (ended.ticks + counts.overruns):.2g} %)"
    refused = "; ".join(
        f"{COUNT_WORDS[name].removeprefix('refused: ')} {n}" for name, n in counts.refusals.items()
    )
    rows: list[tuple[str, str | Text]] = [
        ("time in each mode", _modes(ended)),
        (COUNT_WORDS["overruns"], missed),
        ("frames refused", f"{counts.refused}" + (f" ({refused})" if refused else "")),
    ]
    for name, label in COUNT_WORDS.items():
        if name in counts.refusals or name in _IN_OWN_ROW:
            continue
        if (value := getattr(counts, name)) or name == "lost":
            rows.append((label, str(value)))
    if with_timing:
        timing = ended.timing
        levels = timing.lateness_us(), timing.work_us()
        for label, figures in zip(("lateness", "computing time"), levels, strict=True):
            text = " · ".join(f"{level} {value:.0f}" for level, value in figures.items())
            rows.append((f"{label} of a tick, µs", text))
        rows.append(("longest gap, µs", f"{timing.extremes_ns[2] / 1000:.0f}"))
    if ended.diverged is not None:
        where = f"strut {ended.diverged['strut']} at {ended.diverged['t_s']:.3f} s"
        rows.append(("model diverged", styled(where, "red")))
    if ended.log_fault is not None:
        rows.append(("log", styled(ended.log_fault, "red")))
    print_table(("Run", f"{ended.ticks} ticks, ended {ended.state.mode.name}"), rows)
    if with_timing:
        _print_timing_picture(ended)


def _print_timing_picture(ended: "Ended") -> None:
    from rig.pages.timing_picture import draw_run

    try:
        print_text(f"Histograms of lateness and computing time: {draw_run(ended)}")
    except OSError as error:  # such as a full disk; the run is over and its log is whole
        console.print(f"No histograms: {error.strerror}", style="yellow")
