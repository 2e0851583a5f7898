"""A good damper by its record, as a model simple enough to simulate faults in it.

Its force is a straight gas spring and Coulomb friction, from the slowest step, and a curve of
damping over speed, from the fastest one. That is coarse; only what a fault changes in it is used,
and added to what was measured.

References: Dixon, The Shock Absorber Handbook (2007), 6 and 7; Duym, Simulation tools, modelling
and identification for an automotive shock absorber, Vehicle System Dynamics 33 (2000), for the
stiffness of the oil column.
"""

from typing import NamedTuple

import numpy as np

from can_dbc.errors import InputError
from rig.dyno.characterise import Characteristics
from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import MeanStroke
from rig.dyno.strokes import Array

_NODES = 120
"""Speeds at which a curve is kept."""

_FASTER = 1.5
"""Times the largest measured speed to which the curve continues straight, because a fault may move
the piston faster than the machine."""

_UPPER, _LOWER = 0.6, 0.06
"""Shares of the largest speed from which on the curve is its upper line, and where it is its lower.
"""

_TIMES = 720
"""Times of a cycle at which it is run; two cycles, of which the second counts."""


class DampingCurve(NamedTuple):
    """Damping over speed of one direction, rising from zero.

    Attributes:
        speed_m_per_s: Speeds, from zero, shape (120,).
        force_n: Damping forces, positive, shape (120,).
    """

    speed_m_per_s: Array
    force_n: Array

    def force(self, speed_m_per_s: Array) -> Array:
        """Damping at speeds."""
        return np.interp(speed_m_per_s, self.speed_m_per_s, self.force_n)

    def upper_line(self) -> tuple[float, float]:
        """Force at no speed and slope of the line through the fastest part."""
        top = self.speed_m_per_s[-2]
        fast = (self.speed_m_per_s >= _UPPER * top) & (self.speed_m_per_s <= top)
        slope, at_zero = np.polyfit(self.speed_m_per_s[fast], self.force_n[fast], 1)
        return float(at_zero), float(slope)

    def lower_slope(self) -> float:
        """Slope of the line from no speed through the slowest part."""
        low = _LOWER * self.speed_m_per_s[-2]
        return float(self.force(np.array(low)) / low)

    def speed(self, force_n: Array) -> Array:
        """Speeds at which the damping is some force."""
        return np.interp(force_n, self.force_n, self.speed_m_per_s)


class Master(NamedTuple):
    """A good damper.

    Attributes:
        gas_n: Gas force at the middle of the slowest step.
        gas_rate_n_per_m: Its rise per compression.
        middle_m: That height.
    """

    characteristics: Characteristics
    gas_n: float
    gas_rate_n_per_m: float
    middle_m: float
    friction_n: float
    compression: DampingCurve
    rebound: DampingCurve

    def gas(self, height_m: Array) -> Array:
        """Gas force at heights."""
        return self.gas_n + self.gas_rate_n_per_m * (self.middle_m - height_m)

    def damping(self, velocity_m_per_s: Array) -> Array:
        """Damping at velocities: positive in compression."""
        speed = np.abs(velocity_m_per_s)
        down, up = self.compression.force(speed), self.rebound.force(speed)
        return np.where(velocity_m_per_s < 0.0, down, -up)


def master_of(record: Characteristics) -> Master:
    """A good damper from its record.

    Raises:
        InputError: It has no step slow enough for gas force and friction.
    """
    refuse_unsuitable(record)
    damper = record.damper
    if damper.gas_force_n is None or damper.gas_rate_n_per_m is None or damper.friction_n is None:
        raise InputError(
            f"{record.name}: no step of 5 mm/s or less, expected one in a master record: it gives "
            "gas force and friction"
        )
    slowest, *others = sorted(record.steps, key=lambda step: step.peak_speed_m_per_s)
    fastest = max(record.steps, key=lambda step: step.peak_speed_m_per_s)
    friction_n, gas_n = slowest.half_difference_n.value, slowest.mean_force_n.value
    if others:
        # Bleed in the slowest step: the increase up to the next step, scaled by speed.
        speed, more = slowest.peak_speed_m_per_s, others[0]
        share = speed / max(more.peak_speed_m_per_s - speed, 1e-9)
        friction_n -= share * max(more.half_difference_n.value - friction_n, 0.0)
        gas_n -= share * (more.mean_force_n.value - gas_n)
    friction_n = max(friction_n, 0.0)
    bare = Master(
        record,
        gas_n,
        damper.gas_rate_n_per_m.value,
        slowest.middle_m,
        friction_n,
        *(DampingCurve(np.zeros(2), np.zeros(2)),) * 2,
    )
    down, up = (_curve(bare, stroke) for stroke in fastest.strokes)
    return bare._replace(compression=down, rebound=up)


def refuse_unsuitable(record: Characteristics) -> None:
    """Refuse a record in which faults cannot be identified: clipped, wrong sign, constant speed.

    Raises:
        InputError: It is such a record.
    """
    if any(stroke.is_clipped for step in record.steps for stroke in step.strokes):
        raise InputError(
            f"{record.name}: the load cell was clipped, expected a record of whole forces: its "
            "faults would be taken for the damper's"
        )
    if any(step.energy_per_cycle_j.high < 0.0 for step in record.steps):
        raise InputError(
            f"{record.name}: the strut gives energy, expected the force of a damper (is its sign "
            "right?)"
        )
    if any(stroke.is_constant for step in record.steps for stroke in step.strokes):
        raise InputError(
            f"{record.name}: a step of constant speed, expected sines: faults are run in those"
        )


def _curve(bare: Master, stroke: MeanStroke) -> DampingCurve:
    """Damping over speed: a stroke without gas and friction, mean of both its halves."""
    damping_n = -stroke.sign * (stroke.force_n - bare.gas(stroke.height_m)) - bare.friction_n
    speed = np.abs(stroke.velocity_m_per_s)
    top = int(np.argmax(speed))
    peak = float(speed[top])
    nodes = np.linspace(0.0, peak, _NODES - 1)
    halves: list[Array] = []
    for part in (slice(None, top + 1), slice(top, None)):
        order = np.argsort(speed[part])
        halves.append(np.interp(nodes, speed[part][order], damping_n[part][order]))
    force = np.maximum.accumulate(np.maximum(0.5 * (halves[0] + halves[1]), 0.0))
    force[0] = 0.0
    force = force + 1e-6 * np.arange(len(force))  # rising, so that it can be turned round
    slope = max(float(np.polyfit(nodes[-20:], force[-20:], 1)[0]), 1.0)
    farther = _FASTER * peak
    last = force[-1] + slope * (farther - peak)
    speeds: Array = np.append(nodes, farther).astype(np.float64)
    return DampingCurve(speeds, np.append(force, last).astype(np.float64))


class Cycle(NamedTuple):
    """Two cycles of a step as it is run.

    Attributes:
        interval_s: Time between two points.
        height_m: Heights, shape (N,).
        velocity_m_per_s: Velocities, shape (N,).
    """

    interval_s: float
    height_m: Array
    velocity_m_per_s: Array


def cycle_of(step: DynoStep) -> Cycle:
    """A sine of a step's amplitude and speed."""
    omega = step.peak_speed_m_per_s / step.amplitude_m
    angle = 2.0 * np.pi * np.arange(2 * _TIMES) / _TIMES
    height = step.middle_m + step.amplitude_m * np.sin(angle)
    velocity = omega * step.amplitude_m * np.cos(angle)
    return Cycle(2.0 * np.pi / omega / _TIMES, height, velocity)


def with_compliance(master: Master, cycle: Cycle, rates_n_per_m: Array) -> Array:
    """Damping of the last cycle behind a column of oil that gives way, shape (K, 720).

    The column has the stiffnesses `rates_n_per_m`, shape (K,).
    """
    # Implicit Euler: force + rate * dt * piston velocity(force) rises with the force.
    forces = np.concatenate([-master.rebound.force_n[:0:-1], master.compression.force_n])
    speeds = np.concatenate(
        [master.rebound.speed_m_per_s[:0:-1], -master.compression.speed_m_per_s]
    )
    steps = rates_n_per_m * cycle.interval_s
    sums = forces - steps[:, None] * speeds
    now: Array = np.zeros(len(steps))
    forces_n = np.empty((len(steps), _TIMES))
    for index, velocity in enumerate(cycle.velocity_m_per_s):
        sought = now - steps * velocity
        pairs = zip(sought.tolist(), sums, strict=True)
        now = np.array([np.interp(w, row, forces) for w, row in pairs], dtype=np.float64)
        forces_n[:, index % _TIMES] = now
    return forces_n


def with_play(master: Master, cycle: Cycle, plays_m: Array) -> Array:
    """Force of the last cycle where the damper's eye has play, shape (K, 720).

    The eye may move by `plays_m`, shape (K,), without force; the cycle is the machine's motion.
    """
    forces_n = np.empty((len(plays_m), _TIMES))
    gap = np.zeros_like(plays_m)  # from the side on which the strut pushes
    for index, (height, velocity) in enumerate(
        zip(cycle.height_m, cycle.velocity_m_per_s, strict=True)
    ):
        gas = float(master.gas(np.array(height)))
        kinetic = -np.sign(velocity) * master.friction_n
        held = gas + kinetic + float(master.damping(np.array(velocity)))
        # Without force from the machine the gas moves the piston against friction and damping.
        over = max(gas - master.friction_n, 0.0)
        free = float(master.rebound.speed(np.array(over)))
        is_pushing = (gap <= 0.0) & (held >= 0.0)
        is_pulling = (gap >= plays_m) & (held <= 0.0)
        in_contact = is_pushing | is_pulling
        moved = gap + (velocity - free) * cycle.interval_s
        inside = np.clip(moved, 0.0, plays_m)
        # Share of the interval after the gap closes within it.
        contact_share = np.abs(moved - inside) / max(abs(velocity - free) * cycle.interval_s, 1e-12)
        is_held = held <= 0.0 if velocity > free else held >= 0.0
        forces_n[:, index % _TIMES] = np.where(in_contact, held, held * contact_share * is_held)
        gap = np.where(in_contact, gap, inside)
    return forces_n
