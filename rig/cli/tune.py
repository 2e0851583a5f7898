"""`rig tune`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError, expected_name
from rig.cli.progress import progress_bar
from rig.cli.terminal import (
    ConfigFile,
    JsonFlag,
    console,
    print_json,
    print_table,
    print_text,
    refuse_existing,
)

if TYPE_CHECKING:
    from rig.plan.plan import Plan
    from rig.tuning.latency import Latency
    from rig.tuning.tune import StatedExpectation, TunedStrut

EXAMPLES = (
    "Examples: `rig tune rig.yaml --run runs/7 --out tuned.yaml` · "
    "`rig tune rig.yaml --residual-n 80 --up-to-hz 5 --observer pi` · after a correction: "
    "`rig tune rig.yaml --model found/corrected.yaml --run runs/7 --out tuned-corrected.yaml`"
)


_HARDLY = 0.8
"""Share of the configured observer's expected error above which tuning hardly helps."""

_WORTH_A_LINE = 0.5
"""Share of the residual force that a force which arrives late must cause to be reported."""

Run = Annotated[
    Path | None,
    typer.Option(
        metavar="RUN",
        help="Run with some seconds of the bench's usual motion, from which noise, residual force "
        "and latency are estimated.",
    ),
]
ResidualRms = Annotated[
    float | None,
    typer.Option(metavar="N", min=1e-6, help="Without a run: RMS of the residual force."),
]
HighestFrequency = Annotated[
    float | None,
    typer.Option(
        metavar="HZ", min=1e-6, help="Without a run: highest frequency of the residual force."
    ),
]
NoiseStd = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        min=1e-12,
        max=1.0,
        help="Without a run: standard deviation of the height's noise; by default that of its "
        "quantisation, from the signal's resolution in the DBC.",
    ),
]
GainMargin = Annotated[
    float | None,
    typer.Option(
        metavar="FACTOR",
        min=1.0,
        max=20.0,
        help="Required gain margin: factor by which the model may respond to the virtual force "
        "more strongly, or less, than the observer assumes while the loop of the two stays stable; "
        "1.1 for kalman and 2 for pi by default.",
    ),
]

SettlingTime = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=0.001,
        max=60.0,
        help="Longest permitted time until an estimate is valid after a start or a disturbance; "
        "0.25 for kalman, unlimited for pi by default.",
    ),
]


def tune_command(
    config: ConfigFile,
    run: Run = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL", help="File or name of another model, such as a corrected one."
        ),
    ] = None,
    residual_n: ResidualRms = None,
    up_to_hz: HighestFrequency = None,
    noise_std_m: NoiseStd = None,
    observer: Annotated[
        str, typer.Option(metavar="KIND", help="kalman (noise-aware), or pi.")
    ] = "kalman",
    damping_ratio: Annotated[
        float,
        typer.Option(
            metavar="RATIO",
            min=0.0,
            max=1.0,
            help="Least permitted damping ratio of the loop of model and observer.",
        ),
    ] = 0.1,
    gain_margin: GainMargin = None,
    settling_s: SettlingTime = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="New file for the tuned configuration, in the folder of CONFIG; with a latency it "
            "also states `delay_s`, and allows older measurements (`stale_after_s`, "
            "`safe_after_s`).",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="New PNG file with the expected error over bandwidth."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Choose the observer gains with the smallest expected error of the estimated force.

    Requires --run, or --residual-n and --up-to-hz.
    """
    from rig.pages.tuning_picture import draw_tuning
    from rig.plan.load import load_plan
    from rig.tuning.gains import KINDS, Aim
    from rig.tuning.tune import tune, write_config

    if observer not in KINDS:
        raise InputError(f"--observer {observer!r}: {expected_name(observer, KINDS)}")
    refuse_existing(out, plot)
    source = _source(run, residual_n, up_to_hz, noise_std_m)
    plan, aim = load_plan(config, model=model), Aim(damping_ratio, gain_margin, settling_s)
    with progress_bar() as bar:
        struts = tune(plan, source, observer, aim, bar)
    _refuse_limits(plan, struts)
    if out is not None:
        write_config(plan, struts, out, model)
    if plot is not None:
        draw_tuning(struts, plot)
    if as_json:
        print_json([_as_dict(strut) for strut in struts])
        return
    for strut in struts:
        _print(strut, damping_ratio)
    for path in (out, plot):
        if path is not None:
            print_text(f"Written: {path}")
    _recall_limit(plan, struts, out or config)
    if out is not None:
        print_text(f"Next: `rig run {out}`")


def _source(
    run: Path | None, residual_n: float | None, up_to_hz: float | None, noise_std_m: float | None
) -> "Path | StatedExpectation":
    from rig.tuning.tune import StatedExpectation

    if run is not None:
        if (residual_n, up_to_hz, noise_std_m) != (None, None, None):
            raise InputError(
                "--run: contains what is to be expected, expected none of --residual-n, "
                "--up-to-hz and --noise-std-m"
            )
        return run
    if residual_n is None or up_to_hz is None:
        raise InputError("expected --run RUN, or --residual-n and --up-to-hz")
    return StatedExpectation(residual_n, up_to_hz, noise_std_m)


def _as_dict(strut: "TunedStrut") -> dict[str, object]:
    from rig.tuning.tune import settings_of

    chosen, latency = strut.tuned, strut.latency
    return {
        "strut": strut.name,
        "observer": settings_of(chosen.observer),
        "noise_std_m": strut.expectation.noise_std_m,
        "delay_s": strut.delay_s,
        "latency": latency and {"value_s": latency.delay_s, "std_s": latency.std_s},
        "bandwidth_hz": strut.bandwidth_hz,
        "expected_force_error_n": {
            "noise": chosen.expected.noise_n,
            "lag": chosen.expected.lag_n,
            "all": chosen.expected.force_n,
            "configured": strut.configured.force_n,
            "paper": strut.published.force_n,
        },
        "damping_ratio": chosen.expected.damping_ratio,
        "damping_ratio_in_motion": chosen.in_motion,
        "gain_margin": chosen.gain_margin,
        "settling_s": chosen.expected.settling_s,
        "poles": [pole._asdict() for pole in chosen.expected.poles],
    }


def _print(strut: "TunedStrut", damping_ratio: float) -> None:
    from rig.tuning.gains import LEAST_IN_MOTION
    from rig.tuning.tune import settings_of

    chosen, expectation = strut.tuned, strut.expectation
    _print_errors(strut, damping_ratio)
    rms_n = float(expectation.power_n2.sum()) ** 0.5
    print_text(
        f"Height: noise {1e6 * expectation.noise_std_m:.3g} µm. Residual force: {rms_n:.3g} N RMS "
        f"({expectation.source})."
    )
    if expectation.by_late_force_n > _WORTH_A_LINE * rms_n:
        print_text(
            f"A part of it, {expectation.by_late_force_n:.3g} N RMS"
            f"{' (other parts compensate it in part)' * (expectation.by_late_force_n > rms_n)}, is "
            "proportional to the rate of the applied force, which acts later in the loop than the "
            "height. `rig diagnose` and `rig evaluate` use the times of the samples and do not "
            "contain this part. A shorter cycle of its message reduces it."
        )
    if strut.latency is not None:
        _print_latency(strut.latency, is_set=bool(strut.delay_s))
    slowest = ", ".join(
        f"{pole.frequency_hz:.3g} Hz with {pole.damping_ratio:.2f}"
        for pole in chosen.expected.poles[:6]
    )
    print_text(f"Poles, the slowest first: {slowest}.")
    print_text(f"observers.{strut.name}: {settings_of(chosen.observer)}")
    if strut.latency is not None and strut.delay_s:
        print_text(f"signals.height.{strut.name}.delay_s: {strut.delay_s:g}")
    if chosen.expected.damping_ratio < 0.99 * damping_ratio:
        console.print(
            f"No gains keep a damping ratio of {damping_ratio:g}; the best "
            f"keep {chosen.expected.damping_ratio:.3f}.",
            style="yellow",
        )
    if chosen.in_motion < LEAST_IN_MOTION:
        console.print(
            "No gains keep the loop stable at every height and speed of this run: expect the "
            "estimate to become invalid there. A higher rate of the height sensor helps.",
            style="yellow",
        )
    if chosen.gain_margin < 0.97 * chosen.required_margin:
        console.print(
            f"No gains keep a gain margin of {chosen.required_margin:g}; the best keep "
            f"{chosen.gain_margin:.3g}.",
            style="yellow",
        )
    if chosen.expected.settling_s > 1.01 * chosen.required_settling_s:
        console.print(
            f"No gains settle within {chosen.required_settling_s:g} s; the best settle in "
            f"{_time_text(chosen.expected.settling_s)}.",
            style="yellow",
        )


def _print_latency(latency: "Latency", *, is_set: bool) -> None:
    low_ms, value_ms, high_ms = (
        1e3 * it for it in (latency.low_s, latency.delay_s, latency.high_s)
    )
    if latency.std_s == float("inf"):
        console.print(
            "Latency of the height: cannot be determined from this run; it contains a single "
            "frequency, or too little motion. Record a sweep or a multisine."
        )
    elif high_ms < 0.0:
        print_text(
            f"Latency of the height: none. The applied force is {-value_ms:.3g} ms later than the "
            f"height (95 %: {-high_ms:.3g} to {-low_ms:.3g} ms): a delay of its sensor, its filter "
            "or the bus."
        )
    else:
        verdict = "" if is_set else "; indistinguishable from zero, so none is set"
        print_text(
            f"Latency of the height: {max(value_ms, 0.0):.3g} ms (95 %: {max(low_ms, 0.0):.3g} to "
            f"{high_ms:.3g} ms){verdict}."
        )


def _print_errors(strut: "TunedStrut", damping_ratio: float) -> None:
    from rig.tuning.gains import LEAST_IN_MOTION, PAPER_HZ

    errors = strut.tuned.expected, strut.configured, strut.published
    rows = [
        (label, *(_error_text(getattr(error, name)) for error in errors))
        for label, name in (("by noise", "noise_n"), ("by lag", "lag_n"), ("RMS", "force_n"))
    ]
    margin = strut.tuned.gain_margin
    in_motion = strut.tuned.in_motion, *strut.others_in_motion
    rows += [
        ("bandwidth", f"{strut.bandwidth_hz:.3g} Hz", "", f"{PAPER_HZ:.3g} Hz"),
        (
            f"least damping ratio (≥ {damping_ratio:g})",
            *(f"{error.damping_ratio:.3f}" for error in errors),
        ),
        (f"the same in motion (≥ {LEAST_IN_MOTION:g})", *(_damping_text(it) for it in in_motion)),
        ("settling time", *(_time_text(error.settling_s) for error in errors)),
        ("gain margin", f"{margin:.3g}" if margin < 20.0 else "20 or more", "", ""),
    ]
    heads = ("expected error of the force", "tuned", "configured", "PI (Cuesta et al., 2021)")
    print_table(heads, rows, f"Observer of “{strut.name}”")
    tuned_n, configured_n = strut.tuned.expected.force_n, strut.configured.force_n
    if tuned_n > _HARDLY * configured_n:
        print_text(
            f"Tuning hardly helps: {tuned_n:.3g} N expected instead of {configured_n:.3g} N. A "
            "height that is sampled more often or with less noise, or a model that lacks less, "
            "reduces the error further."
        )
    residual_n = float(strut.expectation.power_n2.sum()) ** 0.5
    if tuned_n > residual_n:
        text = f"The model alone errs by less: its residual force is {residual_n:.3g} N RMS. An "
        text += "observer then only guards against a change of the bench"
        if strut.tuned.expected.settling_s > 0.9 * strut.tuned.required_settling_s:
            text += "; with a longer --settling-s it adds less noise to the force"
        print_text(f"{text}.")


def _refuse_limits(plan: "Plan", struts: "list[TunedStrut]") -> None:
    """Refuse observers that do not know what a limit of the configuration requires."""
    from rig.plan.limits import struts_without_std

    without = [it.name for it in struts if not it.tuned.observer.knows_std]
    for row in plan.config.supervision.limits:
        if struts_without_std(row, plan.strut_names, without):
            raise InputError(
                f"{plan.source}: supervision.limits has force_std_n, which an observer of this "
                "kind does not state: expected --observer kalman, or no such row"
            )


def _recall_limit(plan: "Plan", struts: "list[TunedStrut]", file: Path) -> None:
    """Print that no stated deviation makes an estimate invalid, or which one the file keeps."""
    from rig.bridge.supervision_limits import LimitedValue

    if not any(it.tuned.observer.knows_std for it in struts):
        return
    present_n = [
        row.high
        for row in plan.config.supervision.limits
        if row.value is LimitedValue.FORCE_STD_N and row.high is not None
    ]
    if present_n:
        print_text(
            f"supervision.limits in {file} keeps force_std_n at {min(present_n):g}, which suited "
            "the former observer: compare it with the stated deviation that `rig run` reports."
        )
        return
    print_text(
        "An estimate remains valid however large a standard deviation it states. `rig run` reports "
        f"at its end how large it was; a limit in {file} holds an estimate that is less certain: "
        "supervision: {limits: [{value: force_std_n, high: N, action: hold}]}"
    )


def _damping_text(ratio: float) -> str:
    return f"{ratio:.3f}" if ratio > 0.0 else "unstable"


def _time_text(time_s: float) -> str:
    return f"{time_s:.3g} s" if time_s < float("inf") else "never"


def _error_text(error_n: float) -> str:
    return f"{error_n:.3g} N" if error_n < 1e9 else "unstable"
