"""A dyno whose two sensors speak CANopen, as a process of its own beside the bridge."""

import math
import random
import time
from multiprocessing.queues import Queue
from queue import Empty

import can
from durand import CANBusNetwork

from tests.sensors.peer import amplifier, encoder, scheduled, send

ENCODER, AMPLIFIER = 5, 6
STEP_NM, CYCLE_MS, HEARTBEAT_MS = 1000, 10, 100
STIFFNESS_N_PER_M, DAMPING_N_S_PER_M, FRICTION_N, FREE_LENGTH_M = 900.0, 150.0, 25.0, 0.5
STANDING_M = 0.4
OFFSET_M = 0.25
"""What the encoder reads less than the height."""
NOISE_N = 0.5
"""Standard deviation of the load cell's noise. Without any, a frame that a busy machine sends late
would be all that is left, and the verdict would depend on it."""

_PARTS = ((0.030, 0.9, 0.0), (0.012, 2.3, 1.1))
"""Amplitude in m, frequency in Hz and phase of the motion."""


def motion(t_s: float | None) -> tuple[float, float]:
    """Height in m and velocity in m/s; at rest before the motion begins."""
    height_m, velocity_m_per_s = STANDING_M, 0.0
    if t_s is None:
        return height_m, velocity_m_per_s
    for amplitude_m, frequency_hz, phase in _PARTS:
        omega = 2.0 * math.pi * frequency_hz
        height_m += amplitude_m * math.sin(omega * t_s + phase)
        velocity_m_per_s += amplitude_m * omega * math.cos(omega * t_s + phase)
    return height_m, velocity_m_per_s


def force_n(height_m: float, velocity_m_per_s: float) -> float:
    """Force of the strut: a spring, a damper, and friction that the model lacks."""
    return (
        STIFFNESS_N_PER_M * (FREE_LENGTH_M - height_m)
        - DAMPING_N_S_PER_M * velocity_m_per_s
        - FRICTION_N * math.tanh(velocity_m_per_s / 0.002)
    )


def read_sensors(t_s: float | None, noise: random.Random) -> tuple[float, float]:
    """What both sensors measure: height in m and, with noise, force in N."""
    height_m, velocity_m_per_s = motion(t_s)
    return height_m, force_n(height_m, velocity_m_per_s) + noise.gauss(0.0, NOISE_N)


def serve(interface: str, channel: str, orders: "Queue[str]") -> None:
    """Send until the order to end; other orders are faults.

    Args:
        interface: python-can's name.
        channel: Its channel.
        orders: `move`, which begins the motion, `emergency`, `well`, `silent`, `short`, `long`, and
            `end`.
    """
    buses = [can.Bus(interface=interface, channel=channel) for _ in range(2)]
    networks = [CANBusNetwork(bus) for bus in buses]
    with scheduled():
        wire = encoder(networks[0], ENCODER, step_nm=STEP_NM, cycle_ms=CYCLE_MS)
        cell = amplifier(networks[1], AMPLIFIER, digits=2)
        for node in (wire, cell):
            node.object_dictionary.write(0x1017, 0, HEARTBEAT_MS)
        began_s, index, moves_from_s, is_short = time.monotonic(), 0, None, False
        noise = random.Random(1)
        while True:
            order = _order(orders)
            if order == "end":
                break
            is_short = {"short": True, "long": False}.get(order, is_short)
            moves_from_s = time.monotonic() if order == "move" else moves_from_s
            _obey(order, wire)
            index += 1
            t_s = index * CYCLE_MS * 1e-3
            # The present time, not the cycle's: a machine that is busy makes a cycle late.
            moved_s = None if moves_from_s is None else time.monotonic() - moves_from_s
            height_m, measured_n = read_sensors(moved_s, noise)
            raw = round((height_m - OFFSET_M) * 1e9 / STEP_NM)
            wire.object_dictionary.write(0x6004, 0, raw)
            cell.object_dictionary.write(0x9130, 1, round(measured_n * 100.0))
            if is_short:
                networks[0].send(0x180 + ENCODER, raw.to_bytes(4, "little"))
            else:
                send(wire)
            send(cell)
            time.sleep(max(0.0, began_s + t_s - time.monotonic()))
        for node in (wire, cell):
            node.object_dictionary.write(0x1017, 0, 0)
    for network in networks:
        network.stop()
    for bus in buses:
        bus.shutdown()


def _order(orders: "Queue[str]") -> str:
    try:
        return orders.get_nowait()
    except Empty:
        return ""


def _obey(order: str, wire) -> None:
    if order == "emergency":
        wire.emcy.set(0x8130, 0x11)
    elif order == "well":
        wire.emcy.set(0, 0)
        wire.object_dictionary.write(0x1017, 0, HEARTBEAT_MS)
    elif order == "silent":
        wire.object_dictionary.write(0x1017, 0, 0)
