"""`rig tune`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.progress import progress_bar
from rig.cli.terminal import ConfigFile, JsonFlag, console, print_json, table

if TYPE_CHECKING:
    from rig.tuning.gains import Aim
    from rig.tuning.tune import StatedExpectation, TunedStrut

EXAMPLES = (
    "Examples: `rig tune rig.yaml --run runs/7 --out tuned.yaml` · "
    "`rig tune rig.yaml --residual-n 80 --up-to-hz 5 --observer pi`"
)


def tune_command(
    config: ConfigFile,
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            metavar="RUN",
            help="A run of the bench, some seconds of its usual motion: noise, residual force and "
            "latency are taken from it.",
        ),
    ] = None,
    residual_n: Annotated[
        float | None,
        typer.Option("--residual-n", min=0.0, help="Without a run: RMS of the residual force, N."),
    ] = None,
    up_to_hz: Annotated[
        float | None,
        typer.Option("--up-to-hz", min=0.0, help="Without a run: its highest frequency, Hz."),
    ] = None,
    noise_std_m: Annotated[
        float | None,
        typer.Option(
            "--noise-std-m",
            min=1e-12,
            max=1.0,
            help="Without a run: standard deviation of the height, m; absent: by the DBC's steps.",
        ),
    ] = None,
    observer: Annotated[str, typer.Option("--observer", help="kalman (noise-aware), or pi.")] = (
        "kalman"
    ),
    damping_ratio: Annotated[
        float, typer.Option("--damping-ratio", min=0.0, max=1.0, help="Least that a pole keeps.")
    ] = 0.1,
    gain_margin: Annotated[
        float | None,
        typer.Option(
            "--gain-margin",
            min=1.0,
            max=20.0,
            help="Factor by which the model may respond more, or less, and stay stable; 1.1 for "
            "kalman and 2 for pi by default.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="Write the configuration, in the folder of CONFIG."
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", metavar="FILE", help="Draw the expected error over bandwidth, PNG."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Find the gains of the observers with the smallest expected error of the force."""
    from rig.pages.tuning_picture import draw_tuning
    from rig.plan.load import load_plan
    from rig.tuning.gains import KINDS, Aim
    from rig.tuning.tune import tune, write_config

    if observer not in KINDS:
        raise InputError(f"--observer {observer!r}: expected one of {', '.join(KINDS)}")
    for path in (out, plot):
        if path is not None and path.exists():
            raise InputError(f"{path}: exists, expected a new file")
    stated = (residual_n, up_to_hz, noise_std_m)
    source = _source(run, stated)
    plan, aim = load_plan(config), Aim(damping_ratio, gain_margin)
    with progress_bar() as bar:
        struts = tune(plan, source, observer, aim, bar)
    if out is not None:
        write_config(plan, struts, out)
    if plot is not None:
        draw_tuning(struts, plot)
    if as_json:
        print_json([_as_dict(strut) for strut in struts])
        return
    for strut in struts:
        _print(strut, Aim(damping_ratio, gain_margin))
    for path in (out, plot):
        if path is not None:
            console.print(f"Written: {path}", markup=False)


def _source(run: Path | None, stated: tuple[float | None, ...]) -> "Path | StatedExpectation":
    from rig.tuning.tune import StatedExpectation

    residual_n, up_to_hz, noise_std_m = stated
    if run is not None:
        if stated != (None, None, None):
            raise InputError(
                "--run: contains what is to be expected, expected none of --residual-n, "
                "--up-to-hz and --noise-std-m"
            )
        return run
    if not residual_n or not up_to_hz:
        raise InputError("rig tune: expected --run RUN, or --residual-n and --up-to-hz above zero")
    return StatedExpectation(residual_n, up_to_hz, noise_std_m)


def _as_dict(strut: "TunedStrut") -> dict[str, object]:
    from rig.tuning.tune import settings_of

    chosen, published = strut.tuned, strut.published
    return {
        "strut": strut.name,
        "observer": settings_of(chosen.observer),
        "noise_std_m": strut.expectation.noise_std_m,
        "delay_s": strut.delay_s,
        "latency": None
        if strut.latency is None
        else {"value_s": strut.latency.delay_s, "std_s": strut.latency.std_s},
        "bandwidth_hz": strut.bandwidth_hz,
        "expected_force_error_n": {
            "noise": chosen.expected.noise_n,
            "lag": chosen.expected.lag_n,
            "all": chosen.expected.force_n,
            "paper": published.force_n,
        },
        "damping_ratio": chosen.expected.damping_ratio,
        "gain_margin": chosen.gain_margin,
        "poles": [pole._asdict() for pole in chosen.expected.poles],
    }


def _print(strut: "TunedStrut", aim: "Aim") -> None:
    from rig.tuning.gains import PAPER_HZ
    from rig.tuning.tune import settings_of

    chosen, published = strut.tuned, strut.published
    shown = table(
        "expected error of the force",
        "tuned",
        "published gains, by mass",
        title=f"Observer of “{strut.name}”",
    )
    for label, name in (("by noise", "noise_n"), ("by lag", "lag_n"), ("RMS", "force_n")):
        values = [getattr(item, name) for item in (chosen.expected, published)]
        shown.add_row(label, *(f"{v:.3g} N" if v < 1e9 else "unstable" for v in values))
    shown.add_row("bandwidth", f"{strut.bandwidth_hz:.3g} Hz", f"{PAPER_HZ:.3g} Hz")
    shown.add_row(
        "least damping ratio",
        f"{chosen.expected.damping_ratio:.3f}",
        f"{published.damping_ratio:.3f}",
    )
    margin = chosen.gain_margin
    shown.add_row("gain margin", f"{margin:.3g}" if margin < 20.0 else "20 or more", "")
    console.print(shown)
    expectation = strut.expectation
    rms_n = float(expectation.power_n2.sum()) ** 0.5
    console.print(
        f"Height: noise {1e6 * expectation.noise_std_m:.3g} µm. Residual force: {rms_n:.3g} N RMS "
        f"({expectation.source}).",
        markup=False,
    )
    if strut.latency is not None and strut.latency.std_s == float("inf"):
        console.print(
            "Height latency: cannot be determined from this run, probably because it contains a "
            "single frequency. Record a sweep or a multisine."
        )
    elif strut.latency is not None:
        low_ms, high_ms = 1e3 * max(strut.latency.low_s, 0.0), 1e3 * strut.latency.high_s
        verdict = "" if strut.delay_s else "; indistinguishable from zero, so none is set"
        console.print(
            f"Latency of the height: {1e3 * strut.latency.delay_s:.3g} ms (95 %: {low_ms:.3g} to "
            f"{high_ms:.3g} ms){verdict}.",
            markup=False,
        )
    slowest = ", ".join(
        f"{pole.frequency_hz:.3g} Hz with {pole.damping_ratio:.2f}"
        for pole in chosen.expected.poles[:6]
    )
    console.print(f"Poles, the slowest first: {slowest}.", markup=False)
    console.print(f"observers.{strut.name}: {settings_of(chosen.observer)}", markup=False)
    if chosen.expected.damping_ratio < 0.99 * aim.damping_ratio:
        console.print(
            f"No gains keep a damping ratio of {aim.damping_ratio:g}; the best "
            f"keep {chosen.expected.damping_ratio:.3f}.",
            style="yellow",
        )
    if margin < 0.97 * chosen.required_margin:
        console.print(
            f"No gains keep a gain margin of {chosen.required_margin:g}; the best keep "
            f"{margin:.3g}.",
            style="yellow",
        )
