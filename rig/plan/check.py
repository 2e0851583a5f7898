"""What can be wrong before a bench moves."""

import stat
from dataclasses import dataclass, replace
from enum import Enum
from math import sqrt

from can_dbc.bus_load import frame_time_s
from can_dbc.codec import si_step
from can_dbc.database import Message
from can_dbc.units import Dimension
from dart_model.spec import InlineSkeleton
from rig.bridge.contract import Plant
from rig.closed_loop.loop import Rhythm
from rig.closed_loop.observability import Unknown, linear_model, observability
from rig.closed_loop.poles import Pole, closed_loop_poles
from rig.observers.pi import PiObserver
from rig.plan.assembly import arrivals, build_bridge, build_plant
from rig.plan.quantities import LOAD_CELL_FORCE
from rig.plan.setup import Setup, load_authentication

LITTLE_DAMPING = 0.02
"""Damping ratio below which a pole is warned of: it rings for some 8 periods to a third."""

_WIDEST_OF_RATE = 1.0 / 3.0
"""Corner of a filter over the rate of its measurements beyond which it smooths nothing."""

_COARSE_OF_WEIGHT = 0.01
"""Force of one step of the height sensor over the model's weight from which it is warned of: the
published method is off by 1.1 % of the strut's peak force in all."""

_OTHERS_MAY_READ = stat.S_IRGRP | stat.S_IROTH
FULL_LOAD, HIGH_LOAD = 1.0, 0.7


class Severity(Enum):
    """Severity of a finding; an error keeps the run from starting."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Finding:
    """One line of the check.

    Attributes:
        severity: Its severity.
        what: What was looked at.
        text: What was found, with figures.
    """

    severity: Severity
    what: str
    text: str

    def as_dict(self) -> dict[str, str]:
        """For `summary.json`."""
        return {"severity": self.severity.value, "what": self.what, "text": self.text}


def check(ready: Setup) -> list[Finding]:
    """Check a configuration: signals and units, rate, bus load, stability.

    Args:
        ready: Configuration, model and DBC.

    Returns:
        All findings, good ones too.

    Raises:
        InputError: The model cannot be built, or a key cannot be read.
        DatabaseError: A signal or its unit is wrong.
    """
    build_bridge(ready)
    config = ready.config
    heights = [ready.database.message(entry.message) for entry in config.signals.height.values()]
    further = {entry.message for _, _, entry in config.signals.sensors()}
    read = {message.name: message for message in heights}
    read |= {name: ready.database.message(name) for name in sorted(further)}
    findings = [
        Finding(
            Severity.OK,
            "signals",
            f"all in {ready.database.path.name}, units converted to SI",
        ),
        *[_protected(message) for message in read.values()],
        *[_rate(message, config.period_ns) for message in heights],
        *_resolution(ready),
        *[
            Finding(
                Severity.WARNING,
                f"rate of {name}",
                "the DBC gives no cycle time: its sensors count as silent after five ticks",
            )
            for name in sorted(further)
            if read[name].cycle_time_ns is None
        ],
        _staleness(ready, heights),
        _load(ready),
        *_authenticated(ready),
    ]
    if config.prescribed_motion is not None:
        text = "the motion is prescribed: no loop is closed that could become unstable"
        return [*findings, Finding(Severity.OK, "poles", text)]
    plant = build_plant(ready)
    return [*findings, *_stability(ready, plant), *_observability(ready, plant)]


def errors(ready: Setup) -> list[Finding]:
    """What keeps a run from starting; arguments and errors as of `check`."""
    return [finding for finding in check(ready) if finding.severity is Severity.ERROR]


def _protected(message: Message) -> Finding:
    if message.protection is None:
        return Finding(
            Severity.WARNING,
            f"protection of {message.name}",
            "none in the DBC: a corrupted, repeated or foreign frame passes as data",
        )
    profile = message.protection.identity.profile.value
    return Finding(Severity.OK, f"protection of {message.name}", f"E2E profile {profile}")


def _rate(message: Message, period_ns: int) -> Finding:
    what = f"rate against {message.name}"
    cycle_ns = message.cycle_time_ns
    if cycle_ns is None:
        return Finding(
            Severity.WARNING, what, "the DBC gives no cycle time: poles assume a frame a tick"
        )
    text = f"a frame every {cycle_ns * 1e-6:g} ms, a tick every {period_ns * 1e-6:g} ms"
    if cycle_ns < period_ns:
        return Finding(
            Severity.WARNING,
            what,
            f"{text}: each is used at its own time, at one core step a frame",
        )
    if cycle_ns % period_ns:
        return Finding(Severity.WARNING, what, f"{text}: no whole number of ticks a frame")
    return Finding(Severity.OK, what, text)


def _resolution(ready: Setup) -> list[Finding]:
    """What one step of each height sensor is to the observer."""
    findings: list[Finding] = []
    config = ready.config
    for name, entry in config.signals.height.items():
        step_m = si_step(ready.database.message(entry.message), entry.signal, Dimension.LENGTH)
        if step_m == 0.0 or config.prescribed_motion is not None:
            continue
        observer = config.observers[name]
        what, text = f"resolution of {name}", f"steps of {step_m * 1e6:.3g} µm"
        is_coarse = False
        if isinstance(observer, PiObserver):
            force_n = step_m * observer.proportional_n_per_m
            text += f", each {force_n:.3g} N at K_P"
            weight_n = _weight_n(ready)
            is_coarse = weight_n is not None and force_n > _COARSE_OF_WEIGHT * weight_n
            hint = ": more than 1 % of the model's weight; see rig tune"
        else:
            follower = getattr(observer, "filter", None)
            noise_m = None if follower is None else follower.noise_std_m
            is_coarse = noise_m is not None and step_m / sqrt(12.0) > noise_m
            hint = ": their rounding alone is more than filter.noise_std_m; see rig tune"
        severity = Severity.WARNING if is_coarse else Severity.OK
        findings.append(Finding(severity, what, text + hint * is_coarse))
    return findings


def _weight_n(ready: Setup) -> float | None:
    """Weight of the model's bodies; None where they stand in a file of their own."""
    skeleton = ready.model.skeleton
    if not isinstance(skeleton, InlineSkeleton):
        return None
    mass_kg = sum(body.mass_kg for body in skeleton.bodies)
    return mass_kg * abs(ready.model.gravity_m_per_s2) or None


def _staleness(ready: Setup, heights: list[Message]) -> Finding:
    stale_ns = round(ready.config.supervision.stale_after_s * 1e9)
    messages = list(heights)
    if ready.config.prescribed_motion is not None:
        cell = ready.config.signals.others[LOAD_CELL_FORCE]
        messages.append(ready.database.message(cell.message))
    slowest_ns = max(message.cycle_time_ns or 0 for message in messages)
    delay_ns = max(entry.delay_ns for entry in ready.config.signals.height.values())
    text = f"stale after {stale_ns * 1e-6:g} ms, slowest measurement every {slowest_ns * 1e-6:g} ms"
    if delay_ns:
        text += f", {delay_ns * 1e-6:g} ms old when it comes"
    if stale_ns < slowest_ns + delay_ns + ready.config.period_ns:
        return Finding(
            Severity.ERROR,
            "supervision.stale_after_s",
            f"{text}: expected more than one cycle, one tick and the delay, or the bridge holds "
            "all the time",
        )
    return Finding(Severity.OK, "supervision.stale_after_s", text)


def _authenticated(ready: Setup) -> list[Finding]:
    asked = ready.config.authentication
    if asked is None:
        return []
    load_authentication(ready)
    text = (
        f"AES-128 CMAC, {asked.mac_bits} bits, freshness {asked.freshness_bits} bits, "
        f"clocks within {asked.clock_tolerance_s:g} s"
    )
    path = ready.source.parent / asked.key_file
    if path.stat().st_mode & _OTHERS_MAY_READ:
        return [
            Finding(
                Severity.ERROR,
                "authentication",
                f"{text}; {path} can be read by others, expected mode 0600",
            )
        ]
    return [Finding(Severity.OK, "authentication", text)]


def _load(ready: Setup) -> Finding:
    config, database = ready.config, ready.database
    sent = config.published_messages()
    names = {entry.message for entry in config.subscribed().values()}.union(sent)
    period_ns = config.period_ns
    load = 0.0
    for name in sorted(names):
        message = database.message(name)
        cycle_ns = message.cycle_time_ns or period_ns
        if name in sent:
            cycle_ns = max(cycle_ns, period_ns)
        if config.authentication is not None:
            length = message.length_bytes + config.authentication.trailer_bytes
            message = replace(message, length_bytes=length, is_fd=True)
        time_s = frame_time_s(message, config.bus.bitrate, config.bus.data_bitrate)
        load += time_s / (cycle_ns * 1e-9)
    rate = f"{config.bus.bitrate / 1e6:g} Mbit/s"
    text = f"{load:.0%} of {rate} with the most stuff bits (configured messages alone)"
    if load > FULL_LOAD:
        return Finding(Severity.ERROR, "bus load", f"{text}: the bus cannot carry it")
    return Finding(Severity.WARNING if load > HIGH_LOAD else Severity.OK, "bus load", text)


def _stability(ready: Setup, plant: Plant) -> list[Finding]:
    observers = tuple(ready.config.observers.values())
    rest = tuple(strut.free_length_m for strut in ready.model.struts)
    every = arrivals(ready)
    rhythm = Rhythm.of(
        ready.config.period_ns,
        max(arrival.interval_ns for arrival in every),
        max(arrival.delay_ns for arrival in every),
    )
    poles = closed_loop_poles(plant, observers, rest, rhythm)
    findings = [_worst(poles), *_bandwidths(ready)]
    late = closed_loop_poles(plant, observers, rest, rhythm._replace(delay=rhythm.delay + 1))
    worst = max(pole.magnitude for pole in late)
    text = f"largest |z| {worst:.5f} with measurements one cycle late"
    if worst < 1.0:
        findings.append(Finding(Severity.OK, "poles, one cycle late", text))
    elif findings[0].severity is not Severity.ERROR:
        text += ": unstable; keep bench and bridge in step, or lower K_P or raise the rate"
        findings.append(Finding(Severity.WARNING, "poles, one cycle late", text))
    return findings


def _bandwidths(ready: Setup) -> list[Finding]:
    """Filters that follow single measurements, because their corner is near the rate's."""
    findings: list[Finding] = []
    for (name, observer), arrival in zip(
        ready.config.observers.items(), arrivals(ready), strict=True
    ):
        follower = getattr(observer, "filter", None)
        if follower is None:
            continue
        rate_hz = 1e9 / arrival.interval_ns
        text = f"{follower.bandwidth_hz:g} Hz of {rate_hz:g} measurements a second"
        if follower.bandwidth_hz > _WIDEST_OF_RATE * rate_hz:
            text += ": follows single measurements, expected a third of them at most; see rig tune"
            findings.append(Finding(Severity.WARNING, f"filter of {name}", text))
        else:
            findings.append(Finding(Severity.OK, f"filter of {name}", text))
    return findings


def _observability(ready: Setup, plant: Plant) -> list[Finding]:
    """Which of the struts' forces are observable from the heights, and which are not, in words."""
    names = [strut.name for strut in ready.model.struts]
    linear = linear_model(plant, [strut.free_length_m for strut in ready.model.struts])
    every = [i for i, name in enumerate(names) if name in ready.config.signals.height]
    forces = [Unknown(f"the residual force of {names[i]}", i) for i in every]
    found = observability(linear, every, forces)
    text = f"the heights tell the residual force of {', '.join(names[i] for i in every)}"
    wrong = [*(item.name for item in found.hidden), *map(_apart, found.confused)]
    if not wrong and not found.together:
        wrong = ["all of these forces at once, which can be in balance: leave out one observer"]
    findings = [
        Finding(Severity.WARNING, "observability", f"the heights do not tell {'; '.join(wrong)}")
        if wrong
        else Finding(Severity.OK, "observability", text)
    ]
    untold: list[str] = []
    for i in every:
        name = names[i]
        of_strut = (
            Unknown(f"the spring's force of {name}", i),
            Unknown("the damper's", i),
            Unknown(f"a preload of {name}", i),
            Unknown("an offset of its height sensor", i, is_offset=True),
        )
        for pair in (of_strut[:2], of_strut[2:]):
            untold += map(_apart, observability(linear, every, pair).confused)
    if untold:
        text = f"the heights do not tell {'; '.join(untold)}: a law or a load cell does"
        findings.append(Finding(Severity.OK, "what heights cannot tell", text))
    for i in every if len(every) > 1 else ():
        name = names[i]
        found = observability(linear, [j for j in every if j != i], forces)
        lost = [*(item.name for item in found.hidden), *map(_apart, found.confused)]
        if lost:
            text = f"the others would not tell {'; '.join(lost)}"
            findings.append(Finding(Severity.OK, f"without the height of {name}", text))
    return findings


def _apart(pair: tuple[Unknown, Unknown]) -> str:
    return f"{pair[0].name} from {pair[1].name}"


def _worst(poles: list[Pole]) -> Finding:
    slowest = max(poles, key=lambda pole: pole.magnitude)
    ringing = min(poles, key=lambda pole: pole.damping_ratio)
    text = (
        f"largest |z| {slowest.magnitude:.5f}; least damped at {ringing.frequency_hz:.1f} Hz "
        f"with damping ratio {ringing.damping_ratio:.3f}"
    )
    # An integrator that is switched off leaves a pole at exactly 1, which harms nothing.
    if ringing.damping_ratio < 0.0 or slowest.magnitude > 1.0 + 1e-6:
        return Finding(
            Severity.ERROR, "poles", f"{text}: unstable, lower the gains or raise the rate"
        )
    if ringing.damping_ratio < LITTLE_DAMPING:
        return Finding(Severity.WARNING, "poles", f"{text}: little damping")
    return Finding(Severity.OK, "poles", text)
