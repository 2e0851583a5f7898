"""`rig zero`."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError, expected_name
from rig.cli.progress import listen_visibly
from rig.cli.terminal import ConfigFile, JsonFlag, print_json, print_text

if TYPE_CHECKING:
    from rig.channels.channel import Channel
    from rig.plan.plan import Plan
    from rig.sensors.mounting import Mounting, Readings

EXAMPLES = (
    "Examples: `rig zero rig.yaml --length-m 0.360`, and again at another length, for the "
    "direction · `rig zero rig.yaml --strut tyre --length-m 0.215` · "
    "`rig zero rig.yaml --tare load_cell_force`"
)

StrutName = Annotated[
    str | None, typer.Option(metavar="NAME", help="Strut, if the model has several.")
]
LengthNow = Annotated[
    float | None,
    typer.Option(
        "--length-m", metavar="M", min=1e-4, max=100.0, help="Present length of the strut, in m."
    ),
]
TareOf = Annotated[
    str | None,
    typer.Option(
        "--tare",
        metavar="CHANNEL",
        help="Force sensor whose tare is measured: applied_force, load_cell_force, or "
        "STRUT.SENSOR of a further sensor. No force may act on it, unless --force-n states it.",
    ),
]
ForceNow = Annotated[
    float | None,
    typer.Option(
        "--force-n",
        metavar="N",
        min=-1e7,
        max=1e7,
        help="With --tare: present force on the sensor, such as that of a weight or of a constant "
        "set point, with the sign of the channel.",
    ),
]
ListenSeconds = Annotated[
    float, typer.Option(metavar="S", min=0.1, max=600.0, help="Time to listen.")
]
FromRun = Annotated[
    Path | None, typer.Option(metavar="RUN", help="Use a run recorded at rest instead of the bus.")
]


def zero_command(
    config: ConfigFile,
    strut: StrutName = None,
    length_m: LengthNow = None,
    tare: TareOf = None,
    force_n: ForceNow = None,
    listen_s: ListenSeconds = 2.0,
    run: FromRun = None,
    is_remounted: Annotated[
        bool,
        typer.Option(
            "--remounted",
            help="The sensor has been moved since its last zero: do not determine direction and "
            "scale from that zero.",
        ),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Measure zero, direction or tare of a sensor at rest, and write them into the configuration.

    The first call with --length-m gives the zero. A second call at another length, 5 mm or more
    away, gives the direction and checks the scale. Nothing is sent on the bus.
    """
    from rig.plan.load import load_plan
    from rig.sensors.mounting import as_read, entry_of, find_tare, find_zero, write_mounting

    if (length_m is None) == (tare is None):
        raise InputError("expected one of --length-m and --tare")
    if force_n is not None and tare is None:
        raise InputError(f"--force-n {force_n:g}: expected --tare CHANNEL with it")
    plan = load_plan(config)
    channel = _channel(plan, strut, tare)
    readings = _read(as_read(plan), channel.name, listen_s, run)
    before = entry_of(plan, channel)
    if length_m is None:
        found = find_tare(readings, force_n or 0.0, before, channel.step)
    else:
        found = find_zero(readings, length_m, before, is_remounted=is_remounted)
    write_mounting(plan, channel, found)
    if as_json:
        scale = {} if found.scale is None else {"scale": found.scale}
        print_json({"channel": channel.key, **readings._asdict(), **found.keys, **scale})
        return
    _print(config, channel, readings, found, is_only_strut=len(plan.heights) == 1)


def _channel(plan: "Plan", strut: str | None, tare: str | None) -> "Channel":
    from can_dbc.units import Dimension
    from rig.sensors.mounting import find_channel

    if tare is None:
        names = [channel.name for channel in plan.heights]
        if strut is None and len(names) > 1:
            raise InputError(f"--strut: expected one of {', '.join(names)}")
        name = names[0] if strut is None else strut
        if name not in names:
            raise InputError(f"--strut {name}: no height is measured, {expected_name(name, names)}")
        return find_channel(plan, name)
    channel = find_channel(plan, tare)
    if channel.quantity.dimension is not Dimension.FORCE:
        raise InputError(f"--tare {tare}: is no force, expected --length-m for a height")
    return channel


def _read(plan: "Plan", name: str, listen_s: float, run: Path | None) -> "Readings":
    from rig.sensors.mounting import readings_of

    if run is not None:
        return readings_of(run, plan, name)
    with tempfile.TemporaryDirectory() as folder:
        listen_visibly(plan, listen_s, Path(folder) / "run")
        return readings_of(Path(folder) / "run", plan, name)


def _print(
    config: Path,
    channel: "Channel",
    readings: "Readings",
    found: "Mounting",
    *,
    is_only_strut: bool,
) -> None:
    is_length = "zero" in found.keys
    scale, unit = (1e3, "mm") if is_length else (1.0, "N")
    print_text(
        f"{channel.name} reads {readings.mean * scale:.6g} {unit} "
        f"({readings.samples} samples in {readings.duration_s:.3g} s; standard deviation "
        f"{readings.std * scale:.3g} {unit}, drift {readings.drift * scale:.3g} {unit})"
    )
    for key, value in found.keys.items():
        print_text(f"{channel.key}.{key}: {value}")
    if found.scale is not None:
        print_text(
            f"Scale by the two lengths: {abs(found.scale):.4f}, expected 1 within the error of the "
            "rule; otherwise the scale in the DBC is wrong"
        )
    print_text(f"Written: {config}")
    if is_length and found.scale is None:
        strut = "" if is_only_strut else f" --strut {channel.name}"
        print_text(
            "This length does not show the direction of the sensor. Next: bring the strut to a "
            "second length, 5 mm or more away, and run "
            f"`rig zero {config}{strut} --length-m LENGTH`. If the direction is known, or there is "
            f"no second length, write reversed: true or false into {channel.key} instead"
        )
        return
    print_text(f"Next: `rig check {config}`")
