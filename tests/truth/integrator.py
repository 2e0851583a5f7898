"""Integrates a bench at 20 kHz or more."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tests.truth import compiled
from tests.truth.plant import Bench, Planted, Samples

MINIMUM_RATE_HZ = 20_000


@dataclass(frozen=True)
class Motion:
    """Truth at the samples: (n,) height, velocity, acceleration; (n, effects) forces; memories."""

    height_m: Samples
    velocity_m_per_s: Samples
    acceleration_m_per_s2: Samples
    force_n: Samples
    memory: Samples


def _numbers_of(effects: tuple[Planted, ...]) -> np.ndarray:
    return np.array([compiled.NUMBER.get(effect.law, 0) for effect in effects], dtype=np.int64)


def _rows_of(effects: tuple[Planted, ...]) -> Samples:
    rows = [
        compiled.parameter_row(effect.law, effect.truth)
        if effect.law in compiled.NUMBER
        else np.zeros(compiled.PARAMETERS_MAX)
        for effect in effects
    ]
    return np.array(rows).reshape(len(effects), compiled.PARAMETERS_MAX)


def _sum_of(effects: tuple[Planted, ...], law: str) -> float:
    return sum((next(iter(e.truth.values())) for e in effects if e.law == law), 0.0)


class Drive(NamedTuple):
    """What the run prescribes.

    Attributes:
        force_n: (2 n + 1,) all forces that depend on time alone, at steps and half steps.
        gate: (2 n + 1,) the switching signal, likewise.
        step_s: Length of a step.
        steps: Steps between two samples.
    """

    force_n: Samples
    gate: Samples
    step_s: float
    steps: int


def _system_and_start(
    bench: Bench,
    effects: tuple[Planted, ...],
    drive: Drive,
    body: tuple[float, ...],
    start: tuple[float, float],
) -> tuple[compiled.System, Samples]:
    """The bench as the compiled code wants it, and its first state.

    Args:
        bench: Body, spring, damper.
        effects: What is planted.
        drive: What is prescribed.
        body: States before the memories.
        start: Initial height, ambient temperature in °C.
    """
    height_m, ambient_c = start
    codes = _numbers_of(effects)
    sizes = [compiled.MEMORY.get(effect.law, 0) + 1 for effect in effects]
    at = len(body) + np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    y = np.zeros(int(at[-1]))
    y[: len(body)] = body
    y[at[1:] - 1] = ambient_c
    for effect, begin in zip(effects, at, strict=False):
        if effect.law == "slip_elements":
            memory = compiled.slip_memory(effect.truth, height_m)
            y[begin : begin + memory.size] = memory
    dry = np.flatnonzero(codes == compiled.STICK)
    system = compiled.System(
        bench=np.array(
            [
                bench.mass_kg,
                bench.stiffness_n_per_m,
                bench.damping_n_s_per_m,
                bench.free_length_m,
                bench.gravity_m_per_s2,
            ]
        ),
        codes=codes,
        parameters=_rows_of(effects),
        at=at,
        extra_mass_kg=_sum_of(effects, "rigid_mass"),
        quadratic=_sum_of(effects, "accel_square"),
        stick=int(dry[0]) if dry.size else -1,
        drive_n=drive.force_n,
        gate=drive.gate,
        step_s=drive.step_s,
    )
    return system, y


def integrate(
    bench: Bench, effects: tuple[Planted, ...], drive: Drive, height_m: float, ambient_c: float
) -> Motion:
    """Integrate a bench from rest.

    Args:
        bench: Body, spring, damper.
        effects: What is planted; what depends on time alone must be in the drive.
        drive: What is prescribed.
        height_m: Initial height.
        ambient_c: Ambient temperature.
    """
    system, y = _system_and_start(bench, effects, drive, (height_m, 0.0), (height_m, ambient_c))
    states, accelerations, forces = compiled.run(system, drive.steps, y)
    return Motion(states[:, 0], states[:, 1], accelerations, forces, states[:, 2:])


def follow(
    bench: Bench, effects: tuple[Planted, ...], drive: Drive, path: Samples, ambient_c: float
) -> Motion:
    """Follow the effects along a motion that is prescribed.

    Args:
        bench: Spring and damper.
        effects: What is planted; what depends on time alone has no force here.
        drive: Steps; its force is not read.
        path: (3, 2 n + 1) height, velocity and acceleration at steps and half steps.
        ambient_c: Ambient temperature.
    """
    system, y = _system_and_start(bench, effects, drive, (), (float(path[0, 0]), ambient_c))
    memories, forces = compiled.run_along(system, path, drive.steps, y)
    return Motion(*path[:, :: 2 * drive.steps], forces, memories)
