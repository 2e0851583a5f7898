"""`rig sensor`: sensors on the bus without a DBC."""

import contextlib
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from can_dbc.errors import InputError
from rig.cli.output import JsonFlag, console, print_json, table
from rig.cli.progress import progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.bus.bus import BusConfig
    from rig.bus.canopen_network import CanOpenNetwork
    from rig.sensors.canopen_description import Device
    from rig.sensors.proposal import Origin
    from rig.sensors.scan import Found

app = typer.Typer(
    help="Sensors on the bus without a DBC: find them, describe them, set them to work.",
    no_args_is_help=True,
)

SCAN_EXAMPLES = (
    "Examples: `rig sensor scan --channel can0 --bitrate 500000` · "
    "`rig sensor scan --out found --height-now-m 0.412`, then `rig check found/rig.yaml` · "
    "`rig sensor scan --eds 5=wire.eds --out found`"
)
SET_EXAMPLES = (
    "Examples: `rig sensor set 5 --cycle-ms 2 --heartbeat-ms 100` · "
    "`rig sensor set --restore sensor-5-before.yaml` · `rig sensor set 5 --new`"
)

Interface = Annotated[str, typer.Option("--interface", help="python-can's name of the interface.")]
Channel = Annotated[str, typer.Option("--channel", help="Channel of the interface.")]
Bitrate = Annotated[int, typer.Option("--bitrate", min=1, help="Bit rate in bit/s.")]


@app.command("scan", epilog=SCAN_EXAMPLES)
def scan_command(
    interface: Interface = "socketcan",
    channel: Channel = "can0",
    bitrate: Bitrate = 500_000,
    listen_s: Annotated[
        float, typer.Option("--listen-s", min=0.0, max=600.0, help="How long to listen first.")
    ] = 2.0,
    listen_only: Annotated[
        bool, typer.Option("--listen-only", help="Send nothing: list what is heard.")
    ] = False,
    eds: Annotated[
        list[str] | None,
        typer.Option(
            "--eds",
            metavar="NODE=FILE",
            help="Describe a sensor that is not there by its EDS file; no bus is opened.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="New folder for sensors.dbc and rig.yaml."),
    ] = None,
    height_now_m: Annotated[
        float | None,
        typer.Option(
            "--height-now-m",
            metavar="M",
            help="Height of the strut now: where the first position sensor begins to count.",
        ),
    ] = None,
    is_reversed: Annotated[
        bool, typer.Option("--reversed", help="It counts up while the strut gets shorter.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Find the CANopen and J1939 sensors on a bus, and write a DBC and a configuration.

    Every CANopen node id is asked for its device type and each device for what it sends; a J1939
    bus is asked for addresses; nothing is changed. On a bus with devices of another kind, whose
    frames may mean something else under these ids, use --listen-only.
    """
    from rig.bus.bus import BusConfig

    if out is not None and out.exists():
        raise InputError(f"--out {out}: exists, expected a new folder")
    if is_reversed and height_now_m is None:
        raise InputError("--reversed: expected --height-now-m beside it")
    config = BusConfig(interface, channel, bitrate)
    origin: Origin | None = None
    if eds:
        if height_now_m is not None:
            raise InputError("--height-now-m: an EDS file tells no position, expected the sensor")
        found = _from_files(eds)
    else:
        with _network(config, listen_only=listen_only) as network:
            with progress_bar() as bar:
                from rig.sensors.scan import scan

                found = scan(network, listen_s, progress=bar)
            if height_now_m is not None:
                origin = _origin(network, found.devices, height_now_m, is_reversed=is_reversed)
    written = "" if out is None else _write(out, found, config, origin)
    if as_json:
        print_json(_as_dict(found))
        return
    _print(found)
    if written:
        console.print(written, markup=False)


@app.command("set", epilog=SET_EXAMPLES)
def set_command(
    node_id: Annotated[
        int | None, typer.Argument(metavar="[NODE]", min=1, max=127, help="CANopen node id.")
    ] = None,
    cycle_ms: Annotated[
        int | None,
        typer.Option("--cycle-ms", min=1, max=65_535, help="Time between two measurements."),
    ] = None,
    sync: Annotated[
        bool,
        typer.Option("--sync", help="Send at SYNC, which the device then produces itself."),
    ] = False,
    heartbeat_ms: Annotated[
        int | None,
        typer.Option("--heartbeat-ms", min=1, max=65_535, help="Time between two heartbeats."),
    ] = None,
    new: Annotated[
        bool, typer.Option("--new", help="First give NODE to the device that has no node id (LSS).")
    ] = False,
    before: Annotated[
        Path | None,
        typer.Option(
            "--before",
            metavar="FILE",
            help="New file for what was held before; sensor-NODE-before.yaml if absent.",
        ),
    ] = None,
    restore_from: Annotated[
        Path | None,
        typer.Option("--restore", metavar="FILE", help="Put back what is in this file."),
    ] = None,
    interface: Interface = "socketcan",
    channel: Channel = "can0",
    bitrate: Bitrate = 500_000,
) -> None:
    """Set a CANopen sensor's cycle and heartbeat and start it; or put back what was changed.

    What is changed holds until the device is switched off: nothing is stored in it. A device that
    is put back is left pre-operational, as it is after it was switched on.
    """
    from rig.bus.bus import BusConfig
    from rig.sensors.set_up import Setting, restore, set_to_work
    from rig.sensors.undo import begin_undo, read_undo, write_undo

    config = BusConfig(interface, channel, bitrate)
    if restore_from is not None:
        if node_id is not None or cycle_ms or heartbeat_ms or sync or new or before:
            raise InputError("--restore: expected nothing else to be set beside it")
        changes = read_undo(restore_from)
        with _network(config) as network:
            restore(network, changes)
        console.print(f"Put back: {len(changes)} objects, as {restore_from} has them.")
        return
    if node_id is None:
        raise InputError("rig sensor set: expected NODE, or --restore FILE")
    if sync and cycle_ms is None:
        raise InputError("--sync: expected --cycle-ms beside it")
    kept = before or Path(f"sensor-{node_id}-before.yaml")
    with _network(config) as network:
        if new:
            _give_node_id(network, node_id)
        setting = Setting(network)
        begin_undo(kept)
        try:
            set_to_work(setting, node_id, cycle_ms=cycle_ms, sync=sync, heartbeat_ms=heartbeat_ms)
        except InputError as error:
            left = f"; what was changed is in {kept}" if setting.changed else ""
            raise InputError(f"{error}; the device may be left pre-operational{left}") from error
        finally:
            if setting.changed:
                write_undo(kept, setting.changed)
            else:
                kept.unlink(missing_ok=True)
    if setting.changed:
        text = f"{len(setting.changed)} objects were changed; `rig sensor set --restore {kept}`"
        console.print(f"Node {node_id} was told to start; {text} puts them back.", markup=False)
    else:
        console.print(f"Node {node_id} was told to start; nothing else had to be changed.")


@contextlib.contextmanager
def _network(config: "BusConfig", *, listen_only: bool = False) -> Generator["CanOpenNetwork"]:
    from rig.bus.canopen_network import CanOpenNetwork

    network = CanOpenNetwork(config, listen_only=listen_only)
    try:
        yield network
    finally:
        network.close()


def _give_node_id(network: "CanOpenNetwork", node_id: int) -> None:
    identity = network.find_unconfigured()
    if identity is None:
        raise InputError("--new: no device without a node id answers")
    network.give_node_id(node_id)
    words = ("vendor", "product", "revision", "serial number")
    told = ", ".join(f"{word} {part:#x}" for word, part in zip(words, identity, strict=True))
    console.print(f"Node id {node_id} for {told}.", markup=False)


def _origin(
    network: "CanOpenNetwork", devices: "Sequence[Device]", height_m: float, *, is_reversed: bool
) -> "Origin":
    """Where the first position sensor stands now."""
    from can_dbc.units import Dimension, si_conversion
    from rig.sensors.proposal import Origin, positions

    if not 0.0 < height_m < 100.0:
        raise InputError(f"--height-now-m {height_m}: expected the height of a strut in m")
    place = next(iter(positions(devices)), None)
    if place is None or place.mapped is None or place.node_id is None:
        raise InputError("--height-now-m: no CANopen device sends a length")
    mapped = place.mapped
    content = network.read(place.node_id, mapped.index, mapped.subindex)
    if not content or mapped.meaning.is_float:
        raise InputError(f"--height-now-m: node {place.node_id} does not tell its position")
    raw = int.from_bytes(content, "little") & (1 << mapped.bits) - 1
    if mapped.meaning.is_signed and raw >> mapped.bits - 1:
        raw -= 1 << mapped.bits
    metre = si_conversion(mapped.meaning.unit, Dimension.LENGTH).factor
    return Origin(height_m, raw * mapped.meaning.scale * metre, is_reversed)


def _from_files(given: "Sequence[str]") -> "Found":
    from rig.sensors.canopen_description import described
    from rig.sensors.eds import EdsObjects
    from rig.sensors.scan import Found

    devices: list[Device] = []
    for text in given:
        node, _, name = text.partition("=")
        if not (node.isdigit() and 1 <= int(node) <= 127 and name):
            raise InputError(f"--eds {text}: expected NODE=FILE with a node id of 1 to 127")
        if int(node) in [device.node_id for device in devices]:
            raise InputError(f"--eds {text}: node {node} stands twice")
        device = described(EdsObjects(Path(name), int(node)), int(node))
        if device is None:
            raise InputError(f"{name}: its device type (1000h) has no value")
        devices.append(device)
    return Found(tuple(devices), (), None, (), (), ())


def _write(out: Path, found: "Found", config: "BusConfig", origin: "Origin | None") -> str:
    """Write DBC and configuration; returns what to say of it."""
    from rig.sensors.proposal import CONFIG_NAME, DBC_NAME, configuration_text, dbc_text

    text = configuration_text(found.devices, found.spoken, found.claims, config)
    database = dbc_text(found.devices, found.spoken, origin)
    try:
        out.mkdir(parents=True)
        (out / DBC_NAME).write_text(database, "utf-8")
        (out / CONFIG_NAME).write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    hint = "" if origin is not None else " Heights count as the sensor does (--height-now-m)."
    path = out / CONFIG_NAME
    what = f"Written: {out / DBC_NAME}, {path}.{hint}"
    return f"{what} Read them, set the model, then `rig check {path}`."


def _print(found: "Found") -> None:
    if found.devices:
        _print_devices(found.devices)
    for node_id in found.silent:
        console.print(f"- node {node_id}: heard, but does not describe itself", markup=False)
    if found.unconfigured is not None:
        console.print("- a device without a node id: `rig sensor set NODE --new` gives it one")
    if found.claims or found.spoken:
        _print_addresses(found)
    if found.traffic:
        shown = table("id", "frames", "bytes", "every", title="Heard")
        for item in found.traffic:
            every = "" if item.interval_s is None else f"{item.interval_s * 1e3:.3g} ms"
            name = f"{item.arbitration_id:0{8 if item.is_extended else 3}X}"
            shown.add_row(name, str(item.count), str(item.length_bytes), every)
        console.print(shown)
    if not (found.devices or found.silent or found.claims or found.traffic):
        console.print("Nothing was heard, and nobody answered: is the bit rate right?")


def _print_devices(devices: "Sequence[Device]") -> None:
    shown = table("node", "device", "sends", "heartbeat", title="CANopen")
    for device in devices:
        label = f"{device.label or '?'}\n{device.kind}\n{_identity(device)}"
        beat = f"{device.heartbeat_s * 1e3:g} ms" if device.heartbeat_s else "none"
        shown.add_row(str(device.node_id), escape(label), escape("\n".join(_sent(device))), beat)
    console.print(shown)
    for device in devices:
        for note in device.notes:
            console.print(f"- node {device.node_id}: {note}", markup=False)


def _print_addresses(found: "Found") -> None:
    shown = table("address", "NAME", "maker, function, identity", "sends", title="J1939")
    groups = {item.address: item.group.name for item in found.spoken}
    named = {claim.address: claim for claim in found.claims}
    for address in sorted({*groups, *named}):
        claim = named.get(address)
        name, who = "claims none", ""
        if claim is not None:
            name = f"{claim.name:016X}"
            who = f"{claim.manufacturer}, {claim.function}, {claim.identity}"
        shown.add_row(str(address), name, who, groups.get(address, ""))
    console.print(shown)


def _identity(device: "Device") -> str:
    words = ("vendor", "product", "revision", "serial")
    told = [
        f"{word} {part:#x}"
        for word, part in zip(words, device.identity, strict=True)
        if part is not None
    ]
    return ", ".join(told)


def _sent(device: "Device") -> list[str]:
    lines: list[str] = []
    for pdo in device.pdos:
        every = "at changes" if pdo.cycle_s is None else f"every {pdo.cycle_s * 1e3:g} ms"
        names = ", ".join(
            f"{item.meaning.name} [{item.meaning.scale:g} {item.meaning.unit or '?'}]"
            if not item.meaning.is_alarm
            else item.meaning.name
            for item in pdo.mapped
        )
        lines.append(f"{pdo.arbitration_id:03X} {every}: {names}")
    return lines or ["nothing"]


def _as_dict(found: "Found") -> dict[str, object]:
    from dataclasses import asdict

    return asdict(found)
