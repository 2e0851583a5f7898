"""`rig sensor`: sensors on the bus without a DBC."""

from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from can_dbc.errors import InputError
from rig.cli.plain_help import PlainCommand, PlainGroup
from rig.cli.progress import progress_bar
from rig.cli.terminal import (
    Bitrate,
    Channel,
    Interface,
    JsonFlag,
    console,
    print_json,
    print_table,
    print_text,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.sensors.bus_scan import BusSurvey
    from rig.sensors.canopen_device import CanOpenDevice

app = typer.Typer(
    cls=PlainGroup,
    help="Sensors on the bus without a DBC: find, describe and configure them.",
    no_args_is_help=True,
)

SCAN_EXAMPLES = (
    "Examples: `rig sensor scan --channel can0 --bitrate 500000` · "
    "`rig sensor scan --out found`, then `rig zero found/rig.yaml --length-m 0.412` · "
    "`rig sensor scan --eds 5=wire.eds --out found`"
)
SET_EXAMPLES = (
    "Examples: `rig sensor set 5 --cycle-ms 2 --heartbeat-ms 100` · "
    "`rig sensor set --restore sensor-5-before.yaml` · `rig sensor set 5 --new`"
)

ListenSeconds = Annotated[
    float,
    typer.Option(
        metavar="S", min=0.0, max=600.0, help="Time to listen before the first request, in s."
    ),
]
EdsFiles = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NODE=FILE",
        help="EDS file of the sensor with this node id. The sensor need not be connected: no bus "
        "is opened. May be repeated.",
    ),
]
CycleMs = Annotated[
    int | None,
    typer.Option(metavar="MS", min=1, max=65_535, help="Time between two frames of each TPDO."),
]
HeartbeatMs = Annotated[
    int | None, typer.Option(metavar="MS", min=1, max=65_535, help="Time between two heartbeats.")
]
Before = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="New file for the previous values of the changed objects of the device; "
        "sensor-NODE-before.yaml by default.",
    ),
]


@app.command("scan", epilog=SCAN_EXAMPLES, cls=PlainCommand)
def scan_command(
    interface: Interface = "socketcan",
    channel: Channel = "can0",
    bitrate: Bitrate = 500_000,
    listen_s: ListenSeconds = 2.0,
    listen_only: Annotated[
        bool, typer.Option("--listen-only", help="Send nothing: list the frames on the bus.")
    ] = False,
    eds: EdsFiles = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New folder for sensors.dbc and rig.yaml."),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Find the CANopen and J1939 sensors on a bus; with --out, write a DBC and a configuration.

    The device type is requested from every CANopen node id, the objects that describe it (such as
    the PDO mapping) from each device, the identity from a device without a node id (LSS), and
    address claims from J1939 devices; nothing is changed. On a bus with other devices, for which
    these requests may have another meaning, use --listen-only.
    """
    from rig.bus.bus import BusConfig
    from rig.bus.canopen_network import CanOpenNetwork
    from rig.sensors.bus_scan import scan, survey_of_files
    from rig.sensors.proposed_config import write_proposal

    if out is not None and out.exists():
        raise InputError(f"--out {out}: exists, expected a new folder")
    config = BusConfig(interface, channel, bitrate)
    if eds:
        survey = survey_of_files(_files_by_node(eds))
    else:
        network_of_bus = CanOpenNetwork(config, listen_only=listen_only)
        with closing(network_of_bus) as network, progress_bar() as bar:
            survey = scan(network, listen_s, progress=bar)
    files = None if out is None else write_proposal(out, survey, config)
    if as_json:
        print_json(asdict(survey))
        return
    _print(survey)
    if files is not None:
        dbc, configuration = files
        print_text(
            f"Written: {dbc}, {configuration}. Read them, set the model, then "
            f"`rig zero {configuration} --length-m LENGTH` with the strut's length now."
        )


@app.command("set", epilog=SET_EXAMPLES, cls=PlainCommand)
def set_command(
    node_id: Annotated[
        int | None, typer.Argument(metavar="NODE", min=1, max=127, help="CANopen node id.")
    ] = None,
    cycle_ms: CycleMs = None,
    sync: Annotated[
        bool,
        typer.Option(
            "--sync",
            help="Send at SYNC messages, which the device then produces itself; requires "
            "--cycle-ms.",
        ),
    ] = False,
    heartbeat_ms: HeartbeatMs = None,
    new: Annotated[
        bool,
        typer.Option("--new", help="First assign NODE to the device that has no node id (LSS)."),
    ] = False,
    before: Before = None,
    restore_from: Annotated[
        Path | None,
        typer.Option(
            "--restore",
            metavar="FILE",
            help="Write the previous values in this file (see --before) back to the device.",
        ),
    ] = None,
    interface: Interface = "socketcan",
    channel: Channel = "can0",
    bitrate: Bitrate = 500_000,
    as_json: JsonFlag = False,
) -> None:
    """Set cycle and heartbeat of a CANopen sensor and start the sensor, or undo these changes.

    The changes are lost when the device is switched off: nothing is stored in it. After --restore,
    the device is pre-operational, as after switching on.
    """
    from rig.bus.bus import BusConfig
    from rig.bus.canopen_network import CanOpenNetwork
    from rig.sensors.canopen_set_up import CanOpenSettings, give_node_id, restore
    from rig.sensors.undo_file import configure_with_undo, read_undo

    config = BusConfig(interface, channel, bitrate)
    if restore_from is not None:
        if node_id is not None or cycle_ms or heartbeat_ms or sync or new or before:
            raise InputError("--restore: expected no other setting with it")
        changes = read_undo(restore_from)
        with closing(CanOpenNetwork(config)) as network:
            restore(network, changes)
        if as_json:
            print_json({"restored": len(changes), "file": str(restore_from)})
        else:
            print_text(f"Restored: {len(changes)} objects, from {restore_from}.")
        return
    if node_id is None:
        raise InputError("rig sensor set: expected NODE, or --restore FILE")
    if sync and cycle_ms is None:
        raise InputError("--sync also requires --cycle-ms")
    undo = before or Path(f"sensor-{node_id}-before.yaml")
    with closing(CanOpenNetwork(config)) as network:
        named = _identity_text(give_node_id(network, node_id)) if new else None
        if named is not None and not as_json:
            print_text(f"Node id {node_id} given to {named}.")
        settings = CanOpenSettings(cycle_ms, sync, heartbeat_ms)
        changes = configure_with_undo(network, node_id, settings, undo)
    if as_json:
        file = str(undo) if changes else None
        print_json({"node_id": node_id, "changed": len(changes), "undo": file, "device": named})
        return
    changed = "no object had to be changed."
    if changes:
        changed = f"{len(changes)} objects changed. `rig sensor set --restore {undo}` undoes it."
    print_text(f"Node {node_id}: start requested; {changed}")


def _files_by_node(options: "Sequence[str]") -> dict[int, Path]:
    """EDS file of each node id, from options NODE=FILE."""
    files: dict[int, Path] = {}
    for text in options:
        node, _, name = text.partition("=")
        if not (node.isdigit() and 1 <= int(node) <= 127 and name):
            raise InputError(f"--eds {text}: expected NODE=FILE with a node id of 1 to 127")
        if int(node) in files:
            raise InputError(f"--eds {text}: node {node} is given twice, expected one file")
        files[int(node)] = Path(name)
    return files


def _print(survey: "BusSurvey") -> None:
    _print_devices(survey.devices)
    for node_id in survey.silent:
        print_text(f"- node {node_id}: on the bus, but does not describe itself")
    if survey.unconfigured is not None:
        console.print("- a device without a node id: `rig sensor set NODE --new` gives it one")
    _print_addresses(survey)
    traffic = [
        (
            f"{item.arbitration_id:0{8 if item.is_extended else 3}X}",
            str(item.count),
            str(item.length_bytes),
            "" if item.interval_s is None else f"{item.interval_s * 1e3:.3g} ms",
        )
        for item in survey.traffic
    ]
    if traffic:
        print_table(("id", "frames", "bytes", "every"), traffic, "Frames on the bus")
    if not (survey.devices or survey.silent or survey.claims or survey.traffic):
        console.print("No frame came, and no device answered: check the bit rate.")


def _print_devices(devices: "Sequence[CanOpenDevice]") -> None:
    rows: list[tuple[str, ...]] = []
    for device in devices:
        label = f"{device.label or '?'}\n{device.kind}\n{_identity_text(device.identity)}"
        beat = f"{device.heartbeat_s * 1e3:g} ms" if device.heartbeat_s else "none"
        sends = "\n".join(_pdo_lines(device))
        rows.append((str(device.node_id), escape(label), escape(sends), beat))
    if rows:
        print_table(("node", "device", "sends", "heartbeat"), rows, "CANopen")
    for device in devices:
        for note in device.notes:
            print_text(f"- node {device.node_id}: {note}")


def _print_addresses(survey: "BusSurvey") -> None:
    rows: list[tuple[str, ...]] = []
    groups = {item.address: item.group.name for item in survey.groups}
    claims = {claim.address: claim for claim in survey.claims}
    for address in sorted({*groups, *claims}):
        claim = claims.get(address)
        name, owner = "claims none", ""
        if claim is not None:
            name = f"{claim.name:016X}"
            owner = f"{claim.manufacturer}, {claim.function}, {claim.identity}"
        rows.append((str(address), name, owner, groups.get(address, "")))
    if rows:
        heads = ("address", "NAME", "manufacturer, function, identity", "sends")
        print_table(heads, rows, "J1939")


def _identity_text(identity: "Sequence[int | None]") -> str:
    """Parts of a CANopen identity that are known."""
    words = ("vendor", "product", "revision", "serial number")
    parts = zip(words, identity, strict=True)
    return ", ".join(f"{word} {part:#x}" for word, part in parts if part is not None)


def _pdo_lines(device: "CanOpenDevice") -> list[str]:
    """A line for each process data object that a device sends."""
    lines: list[str] = []
    for pdo in device.pdos:
        every = "at changes" if pdo.cycle_s is None else f"every {pdo.cycle_s * 1e3:g} ms"
        names = ", ".join(
            item.meaning.name
            if item.meaning.is_alarm
            else f"{item.meaning.name} [{item.meaning.scale:g} {item.meaning.unit or '?'}]"
            for item in pdo.mapped
        )
        lines.append(f"{pdo.arbitration_id:03X} {every}: {names}")
    return lines or ["nothing"]
