"""A fleet of simulated dampers on dynos, as CSV files: their formulas are written here."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dart_model.spec import EffectSpec, ModelSpec, dump_model
from tests.diagnosis.little_dyno import DAMPING, FREE, STIFFNESS, model

SAMPLES, RATE_HZ = 1000, 250.0
FRICTION_N, ROUNDING_M_PER_S = 20.0, 0.005
HEIGHT_NOISE_M, FORCE_NOISE_N = 5e-6, 0.5
FIRST = datetime.date(2026, 1, 5)

_LINES = [(0.011 / (1.0 + 0.7 * k), 0.31 + 0.83 * k, 1.3 * k * k) for k in range(7)]


@dataclass(frozen=True)
class Piece:
    """One damper in one week.

    Attributes:
        friction: Factor of its friction.
        damping: Factor of its damping.
        gain: Factor of the bench's load cell.
        quadratic_n_s2_per_m2: Damping that the model lacks.
    """

    friction: float = 1.0
    damping: float = 1.0
    gain: float = 1.0
    quadratic_n_s2_per_m2: float = 0.0


def nominal() -> ModelSpec:
    """The model that the fleet is held against: with friction."""
    values = {"coulomb_force_n": FRICTION_N, "rounding_velocity_m_per_s": ROUNDING_M_PER_S}
    return model().with_effects("strut", [EffectSpec(name="coulomb_friction", parameters=values)])


def write_model(folder: Path) -> Path:
    """The same as a file."""
    path = folder / "model.yaml"
    path.write_text(dump_model(nominal()), "utf-8")
    return path


def write_run(path: Path, piece: Piece, seed: int) -> None:
    """Four seconds of a dyno as CSV."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(SAMPLES) / RATE_HZ
    z, v = np.full(SAMPLES, 0.3), np.zeros(SAMPLES)
    begun_s = 100.0 * rng.uniform()
    for amplitude, frequency, phase in _LINES:
        angle = 2.0 * np.pi * frequency * (t_s + begun_s) + phase
        z += amplitude * np.sin(angle)
        v += 2.0 * np.pi * frequency * amplitude * np.cos(angle)
    force = (
        STIFFNESS * (FREE - z)
        - piece.damping * DAMPING * v
        - piece.friction * FRICTION_N * np.tanh(v / ROUNDING_M_PER_S)
        - piece.quadratic_n_s2_per_m2 * v * np.abs(v)
    )
    z += HEIGHT_NOISE_M * rng.standard_normal(SAMPLES)
    force = piece.gain * force + FORCE_NOISE_N * rng.standard_normal(SAMPLES)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack([t_s, z, force])
    header = "t_s,height_m,strut_force_n"
    np.savetxt(path, rows, fmt=("%.4f", "%.8f", "%.4f"), delimiter=",", header=header, comments="")


def write_fleet(
    folder: Path,
    dampers: int,
    weeks: int,
    piece: Callable[[int, int, np.random.Generator], Piece],
    benches: int = 4,
    seed: int = 0,
) -> list[Path]:
    """A run a damper and week, as ``bench/date/damper.csv``; a damper stays on its bench.

    Args:
        folder: Where to write.
        dampers: How many.
        weeks: How many.
        piece: Of a damper, a week and a generator.
        benches: How many.
        seed: Of all noise.
    """
    paths: list[Path] = []
    for damper in range(dampers):
        for week in range(weeks):
            rng = np.random.default_rng([seed, damper, week])
            day = (FIRST + datetime.timedelta(weeks=week)).isoformat()
            path = folder / f"bench_{damper % benches}" / day / f"A{damper:02d}.csv"
            write_run(path, piece(damper, week, rng), int(rng.integers(2**31)))
            paths.append(path)
    return paths
