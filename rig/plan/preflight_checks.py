"""What can be wrong before a bench moves."""

import stat
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

from can_dbc.bus_load import frame_time_s
from can_dbc.codec import si_range, si_step
from can_dbc.database import Message
from can_dbc.errors import InputError
from dart_model.protocol import AnyPlant
from dart_model.spec import InlineSkeleton, shipped_models
from rig.bridge.incoming_messages import ClockSource, clock_source
from rig.bridge.measurement_age import age_limit_ns
from rig.bridge.published_quantities import FORCE, VALID
from rig.bridge.supervision_limits import Limit, LimitedValue
from rig.bridge.tracked_motion import error_gains, lag_free_hz
from rig.bus.bus import SHARED_INTERFACES, WITHOUT_BIT_RATE, BusError, check_interface
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import LOAD_CELL_FORCE, SWITCHES
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.observability import Unknown, find_corrected, linear_model, observability
from rig.closed_loop.poles import (
    OperatingPoint,
    Pole,
    closed_loop_poles,
    is_stable,
    least_damping,
)
from rig.closed_loop.strut_response import (
    FAST_SPEED_M_PER_S,
    find_driving_speeds_m_per_s,
    linearise_at,
)
from rig.observers.protocol import Remark, SensorStep
from rig.plan.build import build_bridge, build_plant, sample_timing, settling_times
from rig.plan.plan import Plan, PlannedInput, vital_channels
from rig.plan.virtual_sensors import PlannedSensor, make_reader

LITTLE_DAMPING = 0.02
"""Damping ratio below which a pole gives a warning: its oscillation takes about 9 periods to decay
to one third."""

_IN_STEP = "virtual"
"""Interface within one process: a simulated bench on it is in step with the bridge."""

_OTHERS_MAY_READ = stat.S_IRGRP | stat.S_IROTH
FULL_LOAD, HIGH_LOAD = 1.0, 0.7


class Severity(Enum):
    """Severity of a finding; an error prevents the run from starting."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Finding:
    """One line of the check: severity, subject, and result with figures."""

    severity: Severity
    what: str
    text: str

    def as_dict(self) -> dict[str, str]:
        """For `summary.json`."""
        return {"severity": self.severity.value, "what": self.what, "text": self.text}


def check(plan: Plan) -> list[Finding]:
    """Findings of a check of signals and units, rate, bus load and stability; good ones too.

    Raises:
        InputError: The model cannot be built, or a key cannot be read.
        DatabaseError: A signal or its unit is wrong.
    """
    build_bridge(plan)
    heights = [_message(channel) for channel in plan.heights]
    sensors = {message.name: message for message in map(_message, plan.sensors)}
    further = dict(sorted(sensors.items()))
    read = {message.name: message for message in heights} | further
    channel_of = {_message(it).name: it for it in (*plan.heights, *plan.sensors)}
    named = plan.database.path.name
    findings = [
        Finding(Severity.OK, "signals", f"all in {named}, units converted to SI"),
        *(_protection(plan, message) for message in read.values()),
        *[_rate(message, plan.period_ns) for message in heights],
        *map(_sample_times, channel_of.values()),
        *_model(plan),
        *_gravity(plan),
        *_inertia(plan),
        *_lengths(plan),
        *[_zero(plan, channel) for channel in plan.heights],
        *_resolution(plan),
        *[
            Finding(
                Severity.WARNING,
                f"rate of {name}",
                "the DBC gives no cycle time: its sensors count as silent after five ticks",
            )
            for name, message in further.items()
            if message.cycle_time_ns is None
        ],
        _staleness(plan, heights),
        *_switches(plan),
        *_inputs(plan),
        *_interface(plan),
        *_watchdog(plan),
        *_publication(plan),
        *_limits(plan),
        _load(plan),
        *_authentication(plan),
    ]
    if plan.is_prescribed:
        text = "the motion is prescribed: no loop is closed that could become unstable"
        return [*findings, Finding(Severity.OK, "poles", text)]
    plant = build_plant(plan)
    dissipation = _dissipation(plan, plant)
    return [
        *findings,
        *dissipation,
        *_stability(plan, plant),
        *_observability(plan, plant),
        *_virtual_sensors(plan, plant),
    ]


def _virtual_sensors(plan: Plan, plant: AnyPlant) -> list[Finding]:
    """Which virtual sensors the measured heights correct."""
    measured = [i for i, strut in enumerate(plan.struts) if strut.observer.requires_height]
    observed = [i for i in measured if plan.struts[i].observer.estimates_force]
    of_model = {it.name: it.sensor for it in plan.virtual_sensors if it.strut < 0}
    corrected: dict[str, bool] = {}
    if of_model:
        rest_m = [strut.free_length_m for strut in plan.struts]
        reader = make_reader(plant.virtual_sensors, of_model, plan.source)
        found = find_corrected(plant, reader, rest_m, measured, observed)
        corrected = dict(zip(of_model, found, strict=True))
    findings: list[Finding] = []
    for item in plan.virtual_sensors:
        is_corrected = corrected.get(item.name, False)
        if item.strut >= 0:
            is_corrected = item.strut in observed
        text = "no measured height corrects it, or not all of it: it is that of the model alone"
        if is_corrected:
            text = "the measured heights correct it"
            if item.quantity.known_by == "force" and not _knows_forces(plan, item, observed):
                text += "; its standard deviation would be known with observers of kind kalman"
        what = f"virtual sensor {item.name}"
        severity = Severity.OK if is_corrected else Severity.WARNING
        findings.append(Finding(severity, what, text))
    return findings


def _knows_forces(plan: Plan, item: PlannedSensor, observed: Sequence[int]) -> bool:
    """Whether the standard deviations of the forces are known that a sensor depends on."""
    on = [item.strut] if item.strut >= 0 else observed
    return all(plan.struts[strut].observer.knows_std for strut in on)


def errors(plan: Plan) -> list[Finding]:
    """Findings that prevent a run from starting; arguments and errors as of `check`."""
    return [finding for finding in check(plan) if finding.severity is Severity.ERROR]


def refusal(plan: Plan, finding: Finding, cure: str = "") -> InputError:
    """The error of a run that a finding prevents from starting."""
    return InputError(
        f"{plan.source}: {finding.what}: {finding.text} (`rig check` shows all{cure})"
    )


_LONGEST_STRUT_M = 20.0
"""Longer than any strut of a vehicle: such a length is in mm."""

_LEAST_GRAVITY, _LARGEST_GRAVITY = 9.76, 9.84
"""On the Earth's surface, m/s² (9.764 to 9.834)."""


def _message(channel: Channel) -> Message:
    if channel.message is None:
        raise ValueError(f"{channel.key}: expected a channel on a bus")
    return channel.message


def _protection(plan: Plan, message: Message) -> Finding:
    what, protection = f"protection of {message.name}", message.protection
    if protection is None:
        signals = plan.config.signals
        entries = [*signals.height.values(), *signals.inputs.values(), *signals.bench.values()]
        entries += [entry for group in signals.further.values() for entry in group.values()]
        own = [entry for entry in entries if entry.message == message.name]
        text = "none in the DBC: a corrupted, repeated or foreign frame passes as data"
        if any(entry.counter for entry in own):
            text = "no checksum in the DBC: a corrupted frame whose counter is right passes as data"
        return Finding(Severity.WARNING, what, text)
    return Finding(Severity.OK, what, f"E2E profile {protection.identity.profile.value}")


def _model(plan: Plan) -> list[Finding]:
    """Whether a bench on a real bus has a model of its own."""
    if plan.config.bus.interface == _IN_STEP or plan.config.model not in shipped_models():
        return []
    text = f"{plan.config.model} is an example that comes with rig, not this bench: expected a "
    text += "file with its own masses, lengths, stiffness and damping"
    return [Finding(Severity.WARNING, "model", text)]


def _gravity(plan: Plan) -> list[Finding]:
    """Whether gravity is that of the Earth, or none: a wrong unit makes it something else."""
    gravity = plan.model.gravity_m_per_s2
    if gravity == 0.0 or _LEAST_GRAVITY <= abs(gravity) <= _LARGEST_GRAVITY:
        return []
    text = f"{gravity:g} m/s², expected 9.81, or 0 for a horizontal guide"
    return [Finding(Severity.WARNING, "gravity of the model", text)]


def _inertia(plan: Plan) -> list[Finding]:
    """Bodies that rotate and whose moments of inertia are not stated."""
    if not isinstance(plan.model.skeleton, InlineSkeleton):
        return []
    rotating: set[str] = set()
    for body in plan.model.skeleton.bodies:
        if body.joint.type != "prismatic" or body.joint.parent in rotating:
            rotating.add(body.name)
    unstated = [
        body.name
        for body in plan.model.skeleton.bodies
        if body.name in rotating and body.inertia_kg_m2 is None
    ]
    if not unstated:
        return []
    text = f"none stated for {', '.join(unstated)}, which rotates: the number of the mass is taken "
    text += "(10 kg: 10 kg·m²); expected inertia_kg_m2"
    return [Finding(Severity.WARNING, "inertia", text)]


def _lengths(plan: Plan) -> list[Finding]:
    """Free lengths that no strut of a bench has, or that its sensor could not show."""
    found: list[Finding] = []
    for height in plan.heights:
        length_m = plan.struts[height.strut].free_length_m
        low, high = si_range(_message(height), height.signal, height.quantity.dimension)
        span = high - low
        if abs(length_m) <= _LONGEST_STRUT_M and low - span <= length_m <= high + span:
            continue
        text = (
            f"free_length_m is {length_m:g}, and the sensor shows {low:.3g} to {high:.3g} m: "
            "expected a length in metres that it can show"
        )
        found.append(Finding(Severity.WARNING, f"length of {height.name}", text))
    return found


def _zero(plan: Plan, height: Channel) -> Finding:
    """Whether a reading of a height's sensor is known to be the strut's length."""
    entry, what = plan.config.signals.height[height.name], f"zero of {height.name}"
    zero = entry.zero
    one = len(plan.heights) == 1
    measure = f"rig zero {plan.source}{'' if one else f' --strut {height.name}'} --length-m LENGTH"
    if zero is not None:
        text = f"a reading of {zero.reads * 1e3:g} mm is a length of {zero.at_m * 1e3:g} mm"
        if "reversed" not in entry.model_fields_set:
            text += f"; not known whether the sensor is reversed: expected {measure} at a second "
            text += "length, or reversed: true or false in the entry"
            return Finding(Severity.WARNING, what, text)
        return Finding(Severity.OK, what, text + (", reversed" if entry.reversed else ""))
    if _message(height).signal(height.signal).offset:
        return Finding(Severity.OK, what, f"the offset in the DBC; {measure} compares it")
    text = "none was set: what the sensor reads counts as the strut's length; expected zero: "
    text += f"{{reads, at_m}}, which {measure} measures, at any length that is known"
    return Finding(Severity.WARNING, what, text)


def _rate(message: Message, period_ns: int) -> Finding:
    what = f"rate against {message.name}"
    cycle_ns = message.cycle_time_ns
    if cycle_ns is None:
        text = "the DBC gives no cycle time: poles assume a frame a tick"
        return Finding(Severity.WARNING, what, text)
    text = f"a frame every {cycle_ns * 1e-6:g} ms, a tick every {period_ns * 1e-6:g} ms"
    if cycle_ns < period_ns:
        text += ": each is used at its own time, at one core step a frame"
        return Finding(Severity.WARNING, what, text)
    if cycle_ns % period_ns:
        return Finding(Severity.WARNING, what, f"{text}: no whole number of ticks a frame")
    return Finding(Severity.OK, what, text)


def _resolution(plan: Plan) -> list[Finding]:
    """What one step of each height sensor means to its observer."""
    findings: list[Finding] = []
    for channel in plan.heights:
        step_m = si_step(_message(channel), channel.signal, channel.quantity.dimension)
        if step_m == 0.0 or plan.is_prescribed:
            continue
        remark = plan.struts[channel.strut].observer.remark_on_step(
            SensorStep(step_m, _weight_n(plan))
        )
        text = ", ".join(filter(None, (f"steps of {step_m * 1e6:.3g} µm", remark.text)))
        findings.append(_of_remark(f"resolution of {channel.name}", remark, text))
    return findings


def _of_remark(what: str, remark: Remark, text: str) -> Finding:
    return Finding(Severity.WARNING if remark.is_warning else Severity.OK, what, text)


def _weight_n(plan: Plan) -> float | None:
    """Weight of the model's bodies; None where they are declared in another file."""
    skeleton = plan.model.skeleton
    if not isinstance(skeleton, InlineSkeleton):
        return None
    mass_kg = sum(body.mass_kg for body in skeleton.bodies)
    return mass_kg * abs(plan.model.gravity_m_per_s2) or None


def _sample_times(channel: Channel) -> Finding:
    """Where the times of a message's samples come from."""
    message = _message(channel)
    text = {
        ClockSource.TIME_SIGNAL: f"by {channel.time}, whatever the frames wait on their way",
        ClockSource.COUNTER: "by counter and cycle time, whatever the frames wait on their way",
        ClockSource.ARRIVAL: "when their frames arrive: expected a time signal, or a counter and a "
        "cycle time in the DBC",
    }[clock_source(channel, message)]
    return Finding(Severity.OK, f"sample times of {message.name}", text)


_LAG_SHARE = 1e-3
"""Share of a motion that counts as its error by the filter's lag: 10 µm of a centimetre."""

_LONG_STALE_NS, _LONG_STALE_CYCLES = 1_000_000_000, 20
"""Time and cycles beyond which a missing measurement is noticed late, whatever the bench."""


def _staleness(plan: Plan, heights: list[Message]) -> Finding:
    stale_ns = plan.config.supervision.stale_after_ns
    cell = plan.bench_channel(LOAD_CELL_FORCE)
    messages = [*heights, _message(cell)] if plan.is_prescribed and cell is not None else heights
    slowest_ns = max(message.cycle_time_ns or 0 for message in messages)
    delay_ns = max(channel.delay_ns for channel in plan.heights)
    text = f"stale after {stale_ns * 1e-6:g} ms, slowest measurement every {slowest_ns * 1e-6:g} ms"
    if delay_ns:
        text += f", {delay_ns * 1e-6:g} ms old when it arrives"
    is_short = stale_ns < slowest_ns + delay_ns + plan.period_ns
    if is_short:
        text += (
            ": expected more than one cycle, one tick and the delay, or the bridge holds all the "
            "time"
        )
    is_long = stale_ns > _LONG_STALE_NS and stale_ns > _LONG_STALE_CYCLES * slowest_ns
    if is_long:
        text += f": expected at most {_LONG_STALE_CYCLES} cycles, or a sensor is missed late"
    severity = Severity.ERROR if is_short else Severity.WARNING if is_long else Severity.OK
    return Finding(severity, "supervision.stale_after_s", text)


def _inputs(plan: Plan) -> list[Finding]:
    """When an input counts as missing, and what the filter of a motion makes of it."""
    findings: list[Finding] = []
    for item in plan.inputs:
        channel = item.channel
        if channel is None:
            continue
        if item.is_motion:
            findings.append(_followed_motion(item, channel))
        stale_ns = plan.config.supervision.stale_after_ns
        limit_ns = age_limit_ns(channel.interval_ns, stale_ns)
        text = f"missing after {limit_ns * 1e-6:g} ms"
        is_long = limit_ns > plan.config.supervision.safe_after_ns
        severity = Severity.WARNING if is_long else Severity.OK
        if _message(channel).cycle_time_ns is None:
            text += f": the DBC gives {_message(channel).name} no cycle time"
            severity = Severity.WARNING
        findings.append(Finding(severity, channel.key, text))
    return findings


def _followed_motion(item: PlannedInput, channel: Channel) -> Finding:
    """Error that the filter of a motion adds to the height of a strut on the moved body."""
    has_acceleration = item.acceleration is not None
    gains = error_gains(
        item.settling_s, channel.interval_ns * 1e-9, has_acceleration=has_acceleration
    )
    gain = float(gains.noise[0, 0]) ** 0.5
    text = (
        f"followed within {item.settling_s * 1e3:g} ms: heights above it gain {gain:.2g} times the "
        "noise of its position"
    )
    if not has_acceleration:
        text += (
            f", and at most {_LAG_SHARE:.1%} of the motion up to "
            f"{lag_free_hz(item.settling_s, _LAG_SHARE):.2g} Hz: settling_s is the compromise"
        )
    return Finding(Severity.OK, f"motion of {item.name}", text)


def _switches(plan: Plan) -> list[Finding]:
    """Whether interlock and enable signal come often enough, and protected."""
    findings: list[Finding] = []
    safe_ns = plan.config.supervision.safe_after_ns
    for channel in filter(None, map(plan.bench_channel, SWITCHES)):
        message = _message(channel)
        cycle_ns = message.cycle_time_ns
        what = channel.key
        if cycle_ns is not None and cycle_ns + plan.period_ns > safe_ns:
            text = (
                f"{message.name} comes every {cycle_ns * 1e-6:g} ms, open after "
                f"{safe_ns * 1e-6:g} ms without it: expected a longer supervision.safe_after_s"
            )
            findings.append(Finding(Severity.ERROR, what, text))
        else:
            text = f"open after {safe_ns * 1e-6:g} ms without {message.name}"
            findings.append(Finding(Severity.OK, what, text))
        if message not in [_message(height) for height in plan.heights]:
            findings.append(_protection(plan, message))
    return findings


def _interface(plan: Plan) -> list[Finding]:
    """Whether the bus can be opened at all, as far as that is known without doing so."""
    try:
        check_interface(plan.config.bus.interface)
    except BusError as error:
        return [Finding(Severity.ERROR, "bus.interface", str(error))]
    return []


def _watchdog(plan: Plan) -> list[Finding]:
    """Whether anything is sent when the loop stands still or its process dies."""
    config = plan.config
    if not plan.outgoing or config.bus.interface == _IN_STEP:
        return []
    duty = "the bench has to notice itself that its frames stop"
    if not config.supervision.watchdog:
        text = f"switched off: when the loop stands still or dies, {duty}"
    elif config.bus.interface not in SHARED_INTERFACES:
        text = f"none: no second process can use {config.bus.interface}; {duty}"
    else:
        after_ms = config.supervision.safe_after_ns * 1e-6
        text = f"sends the safe output {after_ms:g} ms after the last tick"
        return [Finding(Severity.OK, "supervision.watchdog", text)]
    return [Finding(Severity.WARNING, "supervision.watchdog", text)]


def _publication(plan: Plan) -> list[Finding]:
    """Whether a receiver can see that an estimate is invalid, and why."""
    findings: list[Finding] = []
    for name, published in (plan.config.publish or {}).items():
        if FORCE.key not in published or VALID.key in published:
            continue
        text = "the force is published without valid: what is sent after lost frames looks like"
        text += " a force of the strut; expected publish.valid"
        if plan.config.unsafe.publish_without_valid:
            findings.append(Finding(Severity.WARNING, f"publish.{name}", text))
        else:
            text += ", or unsafe: {publish_without_valid: true}"
            findings.append(Finding(Severity.ERROR, f"publish.{name}", text))
    if not plan.config.status:
        text = "none is published: the bus does not show the bridge's mode"
        findings.append(Finding(Severity.WARNING, "status", text))
    return findings


def _limits(plan: Plan) -> list[Finding]:
    """The limits of each strut, those that follow from the DBC included."""
    findings: list[Finding] = []
    values = {row.value for rows in plan.limits.struts for row in rows}
    has_cell = plan.bench_channel(LOAD_CELL_FORCE) is not None and not plan.is_prescribed
    if has_cell and LimitedValue.FORCE_DIFFERENCE_N not in values:
        text = "none on force_difference_n: a scale that is wrong in the DBC would not be noticed, "
        text += "although the bench has a load cell that shows it"
        findings.append(Finding(Severity.WARNING, "limits of the load cell", text))
    may_freeze = [
        channel.name
        for channel in vital_channels(plan.config, plan.channels)
        if LimitedValue.UNCHANGED_S
        not in {row.value for row in plan.limits.channels[channel.index]}
    ]
    if may_freeze:
        text = f"none on unchanged_s of {' and '.join(may_freeze)}: a sensor that freezes before "
        text += "the run, or as the motion turns, may not be noticed; expected a limit that is "
        text += "longer than the signal stays constant in normal operation"
        findings.append(Finding(Severity.WARNING, "limits of frozen sensors", text))
    for name, rows in zip(plan.strut_names, plan.limits.struts, strict=True):
        text = _describe_rows(rows) or "none"
        is_travel_limited = any(row.value is LimitedValue.MEASURED_HEIGHT_M for row in rows)
        wide = not is_travel_limited and any(map(_limits_no_strut, rows))
        if wide:
            text += "; height_m limits no strut: expected a limit on measured_height_m, with the "
            text += f"travel of {name}"
        severity = Severity.WARNING if wide or not rows else Severity.OK
        findings.append(Finding(severity, f"limits of {name}", text))
    for channel, rows in zip(plan.channels, plan.limits.channels, strict=True):
        if rows and channel.role is not Role.HEIGHT:
            text = _describe_rows(rows)
            findings.append(Finding(Severity.OK, f"limits of {channel.name}", text))
    return findings


def _limits_no_strut(limit: Limit) -> bool:
    """Whether a limit on a height, such as that of a signal in counts, is wider than any travel."""
    if limit.value is not LimitedValue.HEIGHT_M or limit.low is None or limit.high is None:
        return False
    return limit.high - limit.low > _LONGEST_STRUT_M


def _describe_rows(rows: Sequence[Limit]) -> str:
    return "; ".join(f"{row.value.value} {_bounds(row)}: {row.action}" for row in rows)


def _bounds(limit: Limit) -> str:
    if limit.low is None:
        return f"up to {limit.high:.4g}"
    return f"from {limit.low:.4g}" + ("" if limit.high is None else f" to {limit.high:.4g}")


def _authentication(plan: Plan) -> list[Finding]:
    settings = plan.config.authentication
    if settings is None:
        return []
    text = (
        f"AES-128 CMAC, {settings.mac_bits} bits, freshness {settings.freshness_bits} bits, "
        f"clocks within {settings.clock_tolerance_s:g} s, no frame older than "
        f"{max(settings.max_age_s, settings.clock_tolerance_s):g} s"
    )
    path = plan.source.parent / settings.key_file
    is_loaded = plan.authentication is not None
    if is_loaded and path.stat().st_mode & _OTHERS_MAY_READ:
        text += f"; {path} can be read by others, expected mode 0600"
        return [Finding(Severity.ERROR, "authentication", text)]
    return [Finding(Severity.OK, "authentication", text)]


def _load(plan: Plan) -> Finding:
    config = plan.config
    sent = {message.name for message in plan.outgoing_messages()}
    load = 0.0
    for message in sorted(plan.messages(), key=lambda item: item.name):
        cycle_ns = message.cycle_time_ns or plan.period_ns
        if message.name in sent:
            cycle_ns = max(cycle_ns, plan.period_ns)
        if config.authentication is not None:
            length = message.length_bytes + config.authentication.trailer_bytes
            message = replace(message, length_bytes=length, is_fd=True)  # noqa: PLW2901
        time_s = frame_time_s(message, config.bus.bitrate, config.bus.data_bitrate)
        load += time_s / (cycle_ns * 1e-9)
    rate = f"{config.bus.bitrate / 1e6:g} Mbit/s"
    text = f"{load:.0%} of {rate} with the most stuff bits (configured messages alone)"
    if config.bus.interface in WITHOUT_BIT_RATE:
        text += f"; {config.bus.interface} has no bit rate, a CAN bus would have bus.bitrate"
    if load > FULL_LOAD:
        return Finding(Severity.ERROR, "bus load", f"{text}: the bus cannot carry it")
    return Finding(Severity.WARNING if load > HIGH_LOAD else Severity.OK, "bus load", text)


def _dissipation(plan: Plan, plant: AnyPlant) -> list[Finding]:
    """Struts whose force drives the motion above some speed: a disturbed model runs away there."""
    speeds = find_driving_speeds_m_per_s(plant, [strut.free_length_m for strut in plan.struts])
    return [
        Finding(
            Severity.WARNING,
            f"damper of {name}",
            f"drives the motion from {speed:.2g} m/s on instead of damping it, and a disturbed "
            f"model does not come back from there: correct the laws of {plan.config.model}",
        )
        for name, speed in zip(plan.strut_names, speeds, strict=True)
        if speed is not None
    ]


def _stability(plan: Plan, plant: AnyPlant) -> list[Finding]:
    rest = tuple(strut.free_length_m for strut in plan.struts)
    timing = sample_timing(plan)
    poles = closed_loop_poles(plant, plan.observers, rest, timing)
    findings = [_worst(poles)]
    if findings[0].severity is not Severity.ERROR:
        findings += _settling(plan)
    findings += _bandwidths(plan)
    late = closed_loop_poles(plant, plan.observers, rest, timing._replace(delay=timing.delay + 1))
    worst = max(pole.magnitude for pole in late)
    text = f"largest |z| {worst:.5f} with measurements one cycle late"
    if is_stable(late):
        findings.append(Finding(Severity.OK, "poles, one cycle late", text))
        findings.append(_in_motion(plan, plant, rest, timing))
    elif findings[0].severity is not Severity.ERROR:
        # On a bus between two machines nothing keeps the bench in step.
        is_real = plan.config.bus.interface != _IN_STEP
        text += ": unstable; lower the gains or raise the rate (`rig tune` finds gains)"
        severity = Severity.ERROR if is_real else Severity.WARNING
        findings.append(Finding(severity, "poles, one cycle late", text))
    return findings


def _in_motion(plan: Plan, plant: AnyPlant, rest: Sequence[float], timing: SampleTiming) -> Finding:
    """Whether errors decay in a fast motion and at the limits of the travel, too.

    There the model may be in a stop, or its damper beyond a knee.
    """
    limits = plan.config.supervision.limits
    ends = [
        end
        for limit in limits
        if limit.value in (LimitedValue.MEASURED_HEIGHT_M, LimitedValue.HEIGHT_M)
        and (limit.strut or plan.strut_names[0]) == plan.strut_names[0]
        for end in (limit.low, limit.high)
        if end is not None and end > 0.0
    ]
    heights = [rest, *((end, *rest[1:]) for end in ends)]
    points = [OperatingPoint(at, FAST_SPEED_M_PER_S) for at in heights]
    assumed = linearise_at(plant, rest)
    ratio, point = least_damping(plant, plan.observers, timing, assumed, points)
    text = f"least damping ratio {ratio:.3f} at {FAST_SPEED_M_PER_S:g} m/s"
    if point is not None and ratio < 0.0:
        text = (
            f"at {FAST_SPEED_M_PER_S:g} m/s and {point.heights_m[0]:.4g} m, errors grow (damping "
            f"ratio {ratio:.3f}): choose other gains by `rig tune --run` with a run of the usual "
            "motion"
        )
        return Finding(Severity.WARNING, "poles in motion", text)
    return Finding(Severity.OK, "poles in motion", text)


def _settling(plan: Plan) -> list[Finding]:
    """How long each strut's estimate is invalid after a start, a gap or a change of gains."""
    findings: list[Finding] = []
    settling_s = plan.config.supervision.settling_s
    times_ns: list[int | None] = list(
        settling_times(plan)(plan.observers)
        if settling_s is None
        else [round(settling_s * 1e9)] * len(plan.struts)
    )
    for strut, time_ns in zip(plan.struts, times_ns, strict=True):
        subject = f"settling of {strut.name}"
        if time_ns is None:
            text = "never: the estimate would not become valid; see the poles, and rig tune"
            findings.append(Finding(Severity.ERROR, subject, text))
        elif strut.observer.estimates_force:
            text = f"{time_ns * 1e-9:.2g} s"
            if strut.observer.knows_std:
                text += " from when the variance that it states has settled"
            findings.append(Finding(Severity.OK, subject, text))
    return findings


def _bandwidths(plan: Plan) -> list[Finding]:
    """Whether filters smooth, or follow single measurements: their corner is near the rate."""
    remarks = [
        (strut.name, strut.observer.remark_on_rate(1e9 / strut.interval_ns))
        for strut in plan.struts
    ]
    return [_of_remark(f"filter of {name}", it, it.text) for name, it in remarks if it is not None]


def _observability(plan: Plan, plant: AnyPlant) -> list[Finding]:
    """Which of the struts' forces are observable from the heights, and which are not."""
    names = plan.strut_names
    linear = linear_model(plant, [strut.free_length_m for strut in plan.struts])
    measured = [i for i, strut in enumerate(plan.struts) if strut.observer.requires_height]
    observed = [i for i in measured if plan.struts[i].observer.estimates_force]
    if not observed:
        return []
    forces = [Unknown(f"the residual force of {names[i]}", i) for i in observed]
    result = observability(linear, measured, forces)
    hidden = [*(item.name for item in result.hidden), *map(_pair, result.confused)]
    if not hidden and not result.together:
        hidden = ["all of these forces at once, which can be in balance: leave out one observer"]
    shown = ", ".join(names[i] for i in observed)
    severity, text = Severity.OK, f"the residual force of {shown} is observable"
    if hidden:
        severity, text = Severity.WARNING, f"not observable from heights: {'; '.join(hidden)}"
    findings = [Finding(severity, "observability", text)]
    confused: list[str] = []
    for i in observed:
        name = names[i]
        of_strut = (
            Unknown(f"the spring's force of {name}", i),
            Unknown("the damper's", i),
            Unknown(f"a preload of {name}", i),
            Unknown("an offset of its height sensor", i, is_offset=True),
        )
        for pair in (of_strut[:2], of_strut[2:]):
            confused += map(_pair, observability(linear, measured, pair).confused)
    if confused:
        text = f"heights alone do not separate {', or '.join(confused)}: the laws of the model, or "
        text += "a load cell, do"
        findings.append(Finding(Severity.OK, "separability", text))
    for i in measured if len(measured) > 1 else ():
        result = observability(linear, [j for j in measured if j != i], forces)
        lost = [*(item.name for item in result.hidden), *map(_pair, result.confused)]
        if lost:
            text = f"not observable from the others: {'; '.join(lost)}"
            findings.append(Finding(Severity.OK, f"without the height of {names[i]}", text))
    return findings


def _pair(pair: tuple[Unknown, Unknown]) -> str:
    return f"{pair[0].name} and {pair[1].name}"


def _worst(poles: list[Pole]) -> Finding:
    slowest = max(poles, key=lambda pole: pole.magnitude)
    ringing = min(poles, key=lambda pole: pole.damping_ratio)
    text = (
        f"largest |z| {slowest.magnitude:.5f}; least damped at {ringing.frequency_hz:.1f} Hz "
        f"with damping ratio {ringing.damping_ratio:.3f}"
    )
    if not is_stable(poles):
        text += ": unstable, lower the gains or raise the rate"
        return Finding(Severity.ERROR, "poles", text)
    if ringing.damping_ratio < LITTLE_DAMPING:
        return Finding(Severity.WARNING, "poles", f"{text}: little damping")
    return Finding(Severity.OK, "poles", text)
