"""How a sensor is mounted: what it reads at a known length of the strut, or without a force."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.addressing import Directory
from can_dbc.errors import InputError, expected_name
from rig.channels.channel import Channel, MeasuredSignal, Role, Zero
from rig.files.yaml_edit import set_keys
from rig.log.reader import RunFolder, read_run
from rig.plan.plan import Plan
from rig.recordings.run_folder import read_channel
from rig.run.live import live
from rig.run.loop import RunControl

Array = NDArray[np.float64]

_FEWEST = 10
"""Samples from which noise and drift are determined."""

_MOST_MOTION_M = 1e-3
"""Span of nine tenths of the readings beyond which the strut is not at rest."""

_MOST_STD, _MOST_DRIFT = 5.0, 20.0
"""Standard deviation and drift of a force over its noise, beyond which it is not constant: a motion
is hundreds of times the noise, the creep of a cylinder some times."""

_LEAST_CHANGE_M = 5e-3
"""Between two lengths from which direction and scale are determined: a length read off a steel
rule errs by half a millimetre."""

_SCALE_TOLERANCE = 0.2
"""Largest deviation of the scale from 1: two lengths that are 5 mm apart and err by half a
millimetre each show it as well as this."""


class Readings(NamedTuple):
    """Readings of a sensor at rest, in SI.

    Attributes:
        std: Standard deviation about their line.
        drift: Change of that line over their time.
        span: Of the middle nine tenths.
        noise: Standard deviation as neighbouring readings differ: a slow motion is not in it.
    """

    samples: int
    duration_s: float
    mean: float
    std: float
    drift: float
    span: float
    noise: float


def find_channel(plan: Plan, name: str) -> Channel:
    """A channel by its name: a strut, a quantity of the bench, or a sensor as `strut.sensor`.

    Raises:
        InputError: Nothing of that name is measured.
    """
    for channel in plan.channels:
        if channel.name == name:
            return channel
    known = [channel.name for channel in plan.channels]
    raise InputError(f"{plan.source}: {name}: is not measured, {expected_name(name, known)}")


def entry_of(plan: Plan, channel: Channel) -> MeasuredSignal:
    """What the configuration states of a channel."""
    signals = plan.config.signals
    if channel in plan.heights:
        return signals.height[channel.name]
    if channel in plan.sensors:
        strut, _, sensor = channel.name.partition(".")
        return signals.further[strut][sensor]
    name, _, further = channel.name.partition(".")
    if channel.role is Role.INPUT and name in signals.inputs:
        entry = signals.inputs[name]
        return entry.acceleration or entry if further else entry
    return signals.bench[channel.quantity]


def as_read(plan: Plan) -> Plan:
    """The plan of the same sensors as the DBC has them, without limits."""
    unmounted = {"zero": None, "reversed": False, "tare_n": None}
    signals = plan.config.signals
    height = {name: entry.model_copy(update=unmounted) for name, entry in signals.height.items()}
    further = {
        strut: {name: entry.model_copy(update=unmounted) for name, entry in group.items()}
        for strut, group in signals.further.items()
    }
    inputs = {name: entry.model_copy(update=unmounted) for name, entry in signals.inputs.items()}
    bench = {
        quantity.key: entry.model_copy(update=unmounted)
        for quantity, entry in signals.bench.items()
    }
    plain = signals.model_copy(
        update={"height": height, "inputs": inputs, "further": further, **bench}
    )
    supervision = plan.config.supervision.model_copy(update={"limits": ()})
    config = plan.config.model_copy(update={"signals": plain, "supervision": supervision})
    return plan.with_config(config)


def listen(plan: Plan, listen_s: float, folder: Path, control: RunControl) -> None:
    """Record a run that sends nothing.

    Raises:
        InputError: The bus cannot be opened, or the folder cannot be written.
    """
    config = plan.config.model_copy(update={"duration_s": listen_s})
    live(plan.with_config(config), folder, control, listen_only=True)


def readings_of(run: Path, plan: Plan, name: str) -> Readings:
    """The readings of a channel in a run, by a plan as of `as_read`.

    Raises:
        InputError: The run is damaged, or has fewer than ten of them.
    """
    channel = find_channel(plan, name)
    log = read_run(run)
    t_s, values = read_channel(log, channel)
    if len(values) < _FEWEST:
        raise InputError(f"{channel.key}: {describe_arrivals(log, channel, t_s)}")
    return summarise(t_s, values)


def describe_arrivals(run: RunFolder, channel: Channel, valid_s: Array) -> str:
    """What arrived of a channel that does not suffice, and what to do.

    Args:
        run: Of the folder.
        channel: Of a height, or of another measured quantity.
        valid_s: Times of its valid readings in the run, shape (n,).
    """
    received = [frame for frame, direction in run.frames() if direction == "R"]
    if not received or channel.message is None:
        expected = "some" if channel.message is None else f"frames of {channel.message.name}"
        return (
            f"no frames arrived at all, expected {expected}: is the bench sending, and are "
            "interface, channel and bit rate those of its bus?"
        )
    message, directory = channel.message.name, Directory([channel.message])
    own = sum(directory.index_of(f.arbitration_id, f.is_extended) is not None for f in received)
    if not own:
        return (
            f"{len(received)} frames arrived, but none of {message}: is the sensor powered, and is "
            "this its message?"
        )
    if len(valid_s) < _FEWEST:
        return (
            f"{own} frames of {message} arrived, of which {len(valid_s)} hold a valid reading, "
            f"expected at least {_FEWEST}: what does the sensor's valid signal report, and does "
            "the DBC have its length and checksum?"
        )
    interval_s = float(np.median(np.diff(valid_s)))
    cycle_s = (channel.message.cycle_time_ns or 0) * 1e-9
    if 2.0 * interval_s < cycle_s:
        return (
            f"{message} arrives every {interval_s * 1e3:.3g} ms, and the DBC states a cycle of "
            f"{cycle_s * 1e3:g} ms: correct its GenMsgCycleTime in the DBC"
        )
    return (
        f"{own} frames of {message} arrived, {len(valid_s)} with a valid reading: are there gaps "
        "or bursts, or is another height or the applied force missing?"
    )


def summarise(t_s: Array, values: Array) -> Readings:
    """Mean, noise and drift of readings, both of shape (n,), at different times."""
    centred_s, mean = t_s - t_s.mean(), float(values.mean())
    slope = float(centred_s @ values) / float(centred_s @ centred_s)
    residual = values - (mean + slope * centred_s)
    low, high = np.quantile(values, (0.05, 0.95))
    duration_s = float(t_s[-1] - t_s[0])
    std, noise = float(residual.std()), float(np.std(np.diff(values))) / 2.0**0.5
    drift = slope * duration_s
    return Readings(len(values), duration_s, mean, std, drift, float(high - low), noise)


class Mounting(NamedTuple):
    """What was found of a sensor.

    Attributes:
        keys: What is written into its entry of the configuration.
        scale: Change of its reading over that of the length, by two lengths, dimensionless and
            negative for a reversed sensor; None while one length is known.
    """

    keys: dict[str, object]
    scale: float | None = None


def find_zero(
    readings: Readings, length_m: float, before: MeasuredSignal, *, is_remounted: bool
) -> Mounting:
    """The zero of a height's sensor at a known length of the strut.

    A zero that was found before at another length shows the direction of the sensor, and that its
    scale is right; not if it was remounted since.

    Raises:
        InputError: The strut moves, or the reading did not change as the length did.
    """
    if readings.span > _MOST_MOTION_M:
        raise InputError(
            f"the reading moves over {readings.span * 1e3:.3g} mm in {readings.duration_s:.3g} s, "
            f"expected at most {_MOST_MOTION_M * 1e3:g} mm: bring the strut to rest, and measure "
            "again"
        )
    zero: dict[str, object] = {"reads": round(readings.mean, 7), "at_m": length_m}
    last = None if is_remounted else before.zero
    scale = None if last is None else _scale(readings.mean, length_m, last)
    direction: dict[str, object] = {} if scale is None else {"reversed": scale < 0.0}
    return Mounting({"zero": zero, **direction}, scale)


def _scale(reads: float, length_m: float, last: Zero) -> float | None:
    """Change of the reading over that of the length; None between lengths too near."""
    change_m = length_m - last.at_m
    if abs(change_m) < _LEAST_CHANGE_M:
        return None
    scale = (reads - last.reads) / change_m
    if abs(abs(scale) - 1.0) > _SCALE_TOLERANCE:
        raise InputError(
            f"the reading changed by {(reads - last.reads) * 1e3:.4g} mm from a length of "
            f"{last.at_m * 1e3:g} mm to {length_m * 1e3:g} mm, expected {abs(change_m) * 1e3:.4g} "
            "mm up or down: a length is wrong, or the unit or scale in the DBC; --remounted if "
            "the sensor was moved since"
        )
    return scale


def find_tare(
    readings: Readings, force_n: float, before: MeasuredSignal, step_n: float
) -> Mounting:
    """The tare of a force's sensor on which a known force acts, in N by the channel's sign.

    `step_n` is the step of its signal.

    Raises:
        InputError: The force changes by far more than neighbouring readings differ.
    """
    noise_n = max(readings.noise, step_n)
    if readings.std > _MOST_STD * noise_n or abs(readings.drift) > _MOST_DRIFT * noise_n:
        raise InputError(
            f"the force changes while it is read (standard deviation {readings.std:.3g} N, drift "
            f"{readings.drift:.3g} N; neighbouring readings differ by {readings.noise:.2g} N), "
            "expected a constant one: bring the bench to rest, and measure again"
        )
    acting_n = -force_n if before.reversed else force_n
    return Mounting({"tare_n": round(readings.mean - acting_n, 4)})


def write_mounting(plan: Plan, channel: Channel, mounting: Mounting) -> None:
    """Write what was found into the plan's configuration, whose other lines stay.

    Raises:
        InputError: The file cannot be written.
    """
    place = channel.key.split(".")
    try:
        set_keys(plan.source, place, mounting.keys)
    except KeyError:  # a model of one strut leaves its name out
        set_keys(plan.source, place[:-1], mounting.keys)
    except OSError as error:
        raise InputError(f"{plan.source}: cannot be written: {error.strerror}") from error
