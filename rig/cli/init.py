"""`rig init`."""

import math
import os
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.progress import listen_visibly
from rig.cli.terminal import (
    Bitrate,
    Channel,
    Interface,
    JsonFlag,
    print_json,
    print_text,
    refuse_existing,
)

if TYPE_CHECKING:
    from rig.new_bench.first_model import FirstModel, LinearFit
    from rig.new_bench.proposal import Force, Proposal

EXAMPLES = (
    "Examples: `rig init --dbc my.dbc --out my.yaml`, which asks for the rest · `rig init --dbc "
    "my.dbc --out my.yaml --mass-kg 24 --length-at-rest-m 0.36 --stiffness-n-per-m 9000` · with "
    "`--listen-s 10`, stiffness and damping from ten seconds of motion; with `--run sweep.csv`, "
    "from a recording"
)

_ROUGH_HZ = 2.0
"""Natural frequency of the model by which a recording is read: it has no effect on what is read."""

Dbc = Annotated[Path, typer.Option(metavar="FILE", help="DBC of the bench's bus.")]
Out = Annotated[
    Path, typer.Option(metavar="FILE", help="New configuration; its model is written next to it.")
]
Height = Annotated[
    str | None,
    typer.Option(metavar="MESSAGE.SIGNAL", help="Signal of the height, if not the likeliest one."),
]
AppliedForce = Annotated[
    str | None,
    typer.Option(metavar="MESSAGE.SIGNAL", help="Signal of the force on the body, or `none`."),
]
LoadCell = Annotated[
    str | None,
    typer.Option(metavar="MESSAGE.SIGNAL", help="Signal of the load cell in the strut, or `none`."),
]
DamperTemperature = Annotated[
    str | None,
    typer.Option(metavar="MESSAGE.SIGNAL", help="Signal of the damper's temperature, or `none`."),
]
Mass = Annotated[
    float | None,
    typer.Option(
        metavar="KG",
        min=1e-3,
        max=1e6,
        help="Mass that the strut carries, in kg; 10 by default with --dyno.",
    ),
]
LengthAtRest = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        min=1e-3,
        max=100.0,
        help="Length of the strut at rest, in m. Without --free-length-m, the free length follows "
        "from it; the strut is then assumed to carry the weight and no other force (with "
        "--dyno: no load at all).",
    ),
]
FreeLength = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        min=1e-3,
        max=100.0,
        help="Length of the strut without a force, as a drawing states it; by default, it follows "
        "from --length-at-rest-m.",
    ),
]
Stiffness = Annotated[
    float | None,
    typer.Option(
        metavar="N/M", min=1e-3, max=1e9, help="Stiffness of the spring, such as from a catalogue."
    ),
]
Damping = Annotated[
    float | None,
    typer.Option(
        metavar="N.S/M",
        min=0.0,
        max=1e8,
        help="Damping; if absent, that of a damping ratio of 0.2.",
    ),
]
Run = Annotated[
    Path | None,
    typer.Option(
        metavar="RUN", help="Estimate stiffness and damping from a run folder or a CSV file."
    ),
]
ListenSeconds = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=1.0,
        max=600.0,
        help="Listen to the moving bench for S seconds and estimate stiffness and damping.",
    ),
]


def init(
    dbc: Dbc,
    out: Out,
    height: Height = None,
    applied_force: AppliedForce = None,
    load_cell: LoadCell = None,
    temperature: DamperTemperature = None,
    is_dyno: Annotated[
        bool,
        typer.Option(
            "--dyno", help="The bench prescribes the strut's motion; requires a load cell."
        ),
    ] = False,
    mass_kg: Mass = None,
    length_at_rest_m: LengthAtRest = None,
    free_length_m: FreeLength = None,
    stiffness_n_per_m: Stiffness = None,
    damping_n_s_per_m: Damping = None,
    run: Run = None,
    listen_s: ListenSeconds = None,
    interface: Interface = "socketcan",
    channel: Channel = "can0",
    bitrate: Bitrate = 500_000,
    as_json: JsonFlag = False,
) -> None:
    """Propose a configuration and a first model for a bench whose bus a DBC describes.

    Signals are ranked by unit, name, comment, range, step and cycle; the configuration states why
    each was chosen, and which others are possible. In a terminal, the command asks for required
    values that no option states.
    """
    from can_dbc.database import load_database
    from rig.bus.bus import BusConfig
    from rig.new_bench.proposal import Proposal
    from rig.new_bench.signal_choice import SignalNames, choose_signals

    model_file = out.with_name(f"{out.stem}_model.yaml")
    refuse_existing(out, model_file, option="--out ")
    if run is not None and listen_s is not None:
        raise InputError("expected one of --run and --listen-s")
    is_measured = run is not None or listen_s is not None
    if is_measured and (stiffness_n_per_m, damping_n_s_per_m) != (None, None):
        raise InputError(
            "--run and --listen-s estimate stiffness and damping, expected none of "
            "--stiffness-n-per-m and --damping-n-s-per-m with them"
        )
    database = load_database(dbc)
    names = SignalNames(height, applied_force, load_cell, temperature)
    ask = _ask_place if sys.stdin.isatty() else None
    signals = choose_signals(database, names, ask, is_dyno=is_dyno)
    proposal = Proposal(database, signals, BusConfig(interface, channel, bitrate), is_dyno)
    if not sys.stdin.isatty():
        _refuse_missing(
            {
                "--mass-kg": is_dyno or mass_kg is not None,
                "--length-at-rest-m or --free-length-m": (length_at_rest_m, free_length_m)
                != (None, None),
                "--stiffness-n-per-m": is_measured or stiffness_n_per_m is not None,
            }
        )
    mass_kg = _known(mass_kg, "Mass that the strut carries, kg", 10.0 if is_dyno else None)
    if length_at_rest_m is None and free_length_m is None:
        question = "Length of the strut at rest, by a rule, m (or give --free-length-m)"
        length_at_rest_m = _known(None, question, None)
    if not is_measured:
        stiffness_n_per_m = _known(stiffness_n_per_m, "Stiffness, roughly, N/m", None)
    model, source = _first_model(mass_kg, length_at_rest_m, stiffness_n_per_m, damping_n_s_per_m)
    # On a dyno no weight rests on the strut.
    free_length_m = free_length_m or (length_at_rest_m if is_dyno else None)
    model = replace(model, stated_free_length_m=free_length_m)
    if is_measured:
        fit = _measure(proposal, model, run, listen_s)
        model = replace(
            model,
            stiffness_n_per_m=fit.stiffness_n_per_m,
            damping_n_s_per_m=fit.damping_n_s_per_m,
        )
        source = f"from {'the bus' if run is None else run}, explaining {fit.explained:.0%} of it"
    _write(proposal, out, model_file, model, source)
    if as_json:
        print_json(_as_dict(out, model_file, proposal, model))
        return
    _print(out, model_file, proposal, model, source)


def _refuse_missing(given: Mapping[str, bool]) -> None:
    """Refuse a call without a terminal in which options are missing: all of them at once."""
    missing = [option for option, is_given in given.items() if not is_given]
    if missing:
        raise InputError(f"{', '.join(missing)}: required, or answer in a terminal")


def _known(value: float | None, question: str, default: float | None) -> float:
    """A number that an option gave, or that is asked for in a terminal."""
    if value is not None:
        return value
    if default is not None:
        return default
    answer = float(typer.prompt(question, type=float))
    if not 0.0 < answer < 1e9:
        raise InputError(f"{question}: {answer:g}, expected a positive number")
    return answer


def _ask_place(name: str) -> "Force | None":
    """Where a force acts, as the user answers; None for neither place."""
    from rig.new_bench.proposal import Force

    question = f"{name} is a force: applied to the body, in the strut, or neither? (a/s/n)"
    answers = {"a": Force.APPLIED, "s": Force.IN_STRUT, "n": None}
    while (answer := str(typer.prompt(question)).strip().lower()[:1]) not in answers:
        print_text("Expected a, s or n.")
    return answers[answer]


def _first_model(
    mass_kg: float,
    rest_m: float | None,
    stiffness_n_per_m: float | None,
    damping_n_s_per_m: float | None,
) -> "tuple[FirstModel, str]":
    from rig.new_bench.first_model import FirstModel, rough_damping_n_s_per_m

    stiffness = stiffness_n_per_m or mass_kg * (math.tau * _ROUGH_HZ) ** 2
    if damping_n_s_per_m is None:
        damping, source = rough_damping_n_s_per_m(mass_kg, stiffness), "its damping a guess"
    else:
        damping, source = damping_n_s_per_m, "both as stated"
    return FirstModel(mass_kg, rest_m, stiffness, damping), source


def _write(
    proposal: "Proposal", config: Path, model_file: Path, model: "FirstModel", source: str
) -> None:
    """Write configuration and model; neither is there if one cannot be written."""
    dbc = os.path.relpath(proposal.database.path, config.parent)
    try:
        model_file.write_text(model.text(config.stem, source), "utf-8")
        config.write_text(proposal.text(dbc, model_file.name), "utf-8")
    except OSError as error:
        model_file.unlink(missing_ok=True)
        if not config.parent.is_dir():
            raise InputError(f"--out {config}: no folder {config.parent}, make it first") from error
        raise InputError(f"--out {config}: cannot be written: {error.strerror}") from error


def _measure(
    proposal: "Proposal", model: "FirstModel", run: Path | None, listen_s: float | None
) -> "LinearFit":
    """Linear spring and damper from a recording, or from the bench as it moves now."""
    from rig.new_bench.first_model import fit_linear
    from rig.recordings.read import read_recording

    with tempfile.TemporaryDirectory() as folder:
        recording = read_recording(
            _listen(proposal, model, listen_s or 0.0, Path(folder)) if run is None else run
        )
    force = recording.applied_force_n
    try:
        return fit_linear(recording.t_s, recording.heights_m[:, 0], force, model.mass_kg)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from error


def _listen(proposal: "Proposal", model: "FirstModel", listen_s: float, folder: Path) -> Path:
    """Record the bus as proposed; returns the run's folder."""
    from rig.plan.load import load_plan

    config, run = folder / "rig.yaml", folder / "run"
    _write(proposal, config, config.with_name("model.yaml"), model, "to listen by")
    listen_visibly(load_plan(config), listen_s, run)
    return run


def _as_dict(
    out: Path, model_file: Path, proposal: "Proposal", model: "FirstModel"
) -> dict[str, object]:
    signals = proposal.signals
    return {
        "config": str(out),
        "model": str(model_file),
        "signals": {
            choice.quantity.key: {
                "message": choice.message.name,
                "signal": choice.signal.name,
                "why": choice.why,
                "others": list(choice.others),
            }
            for choice in signals.choices
        },
        "unclear_forces": [item.name for item in signals.unclear],
        "mass_kg": model.mass_kg,
        "length_at_rest_m": model.rest_m,
        "free_length_m": model.free_length_m,
        "stiffness_n_per_m": model.stiffness_n_per_m,
        "damping_n_s_per_m": model.damping_n_s_per_m,
        "passed_over": dict(proposal.database.passed_over),
    }


def _print(
    out: Path, model_file: Path, proposal: "Proposal", model: "FirstModel", source: str
) -> None:
    database, signals = proposal.database, proposal.signals
    for choice in signals.choices:
        print_text(f"{choice.quantity.key}: {choice.name} ({choice.comment})")
    for item in signals.unclear:
        print_text(
            f"{item.name} is a force, and it is not clear where it acts. To use it, delete the two "
            f"files and add --applied-force {item.name} for a force on the body, or --load-cell "
            f"{item.name} for one in the strut"
        )
    for item in signals.unknown:
        print_text(f"Not considered: {item}, whose unit is not understood")
    for what, why in database.passed_over.items():
        print_text(f"Passed over in {database.path.name}: {what}: {why}")
    print_text(
        f"Model: {model.mass_kg:g} kg, stiffness {model.stiffness_n_per_m:.0f} N/m, damping "
        f"{model.damping_n_s_per_m:.0f} N·s/m ({source}), free length {model.free_length_m:.4g} m"
    )
    print_text(f"Written: {out}, {model_file}. Read them.")
    length = "LENGTH" if model.rest_m is None else f"{model.rest_m:g}"
    print_text(
        f"Next, with the bench at rest: `rig zero {out} --length-m {length}`, with the length of "
        "the strut that you measure then"
    )
