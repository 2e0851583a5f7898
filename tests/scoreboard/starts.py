"""Rough linear models to begin with, from what a bench measured."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from can_dbc.errors import InputError
from dart_model.spec import (
    WORLD,
    BodySpec,
    InlineSkeleton,
    JointSpec,
    ModelSpec,
    ModelTolerance,
    StrutSpec,
)
from rig.recordings.recording import Recording

Array = NDArray[np.float64]

_UNKNOWN = ModelTolerance.model_validate(
    {"stiffness_n_per_m": "100 %", "damping_n_s_per_m": "100 %"}
)
"""Tolerance of a spring and a damper that only stand for what was measured."""
_SLOW = 0.4
"""Share of the resonance below which a bench answers as its spring."""


def driven_start(record: Recording, name: str, resonance_hz: float) -> ModelSpec:
    """A rough linear model of a force-driven bench, as one would write it down from its data sheet.

    The stiffness is the ratio of force to height well below the resonance, the mass follows from
    the resonance, the damping ratio is 0.05. Without gravity, because a constant force goes into
    the free length.

    Args:
        record: Run with one height and an applied force.
        name: Name of the model.
        resonance_hz: About where the bench resonates.
    """
    if record.applied_force_n is None:
        raise InputError(f"{record.name}: has no applied_force_n, expected a force-driven bench")
    height_m = record.heights_m[:, 0]
    middle_m = float(np.nanmean(height_m))
    rate_hz = 1.0 / float(np.median(np.diff(record.t_s)))
    spectra = cast("Any", signal)
    size = min(4096, len(record.t_s))
    moved_m = np.nan_to_num(height_m - middle_m)
    frequency_hz, cross = spectra.csd(moved_m, record.applied_force_n, rate_hz, nperseg=size)
    power = spectra.welch(moved_m, rate_hz, nperseg=size)[1]
    slow = (frequency_hz > 0.0) & (frequency_hz < _SLOW * resonance_hz)
    stiffness = float(np.real(cross[slow]).sum() / power[slow].sum())
    omega = 2.0 * np.pi * resonance_hz
    mass_kg = stiffness / omega**2
    return one_body(name, (mass_kg, 0.1 * mass_kg * omega, stiffness), middle_m)


def _solved(columns: Array, target: Array) -> list[float]:
    """Least squares."""
    return cast(
        "list[float]", cast("Any", np.linalg.lstsq(columns, target, rcond=None))[0].tolist()
    )


def dyno_start(records: Sequence[Recording], name: str) -> ModelSpec:
    """The spring and damper that come nearest to a dyno's load cell; a mass of 1 kg, unseen.

    Args:
        records: Runs with one height, prescribed, and a strut force.
        name: Name of the model.
    """
    middle_m = float(np.mean([np.nanmean(record.heights_m) for record in records]))
    columns: list[Array] = []
    forces: list[Array] = []
    for record in records:
        if record.strut_forces_n is None:
            raise InputError(f"{record.name}: has no strut_force_n, expected a load cell")
        height_m = record.heights_m[:, 0]
        velocity = np.gradient(height_m, record.t_s)
        columns.append(np.column_stack([middle_m - height_m, -velocity, np.ones_like(height_m)]))
        forces.append(record.strut_forces_n[:, 0])
    stiffness, damping, force_n = _solved(np.concatenate(columns), np.concatenate(forces))
    stiffness, damping = max(stiffness, 1.0), max(damping, 0.0)
    # A constant force is a longer free length, within reason; the rest is left to be found.
    longer_m = float(np.clip(force_n / stiffness, -0.5 * middle_m, 0.5 * middle_m))
    start = one_body(name, (1.0, damping, stiffness), middle_m + longer_m)
    # Of a force with memory these are a linear equivalent: no spring is known.
    return start.model_copy(update={"tolerance": _UNKNOWN})


def one_body(name: str, constants: tuple[float, float, float], free_length_m: float) -> ModelSpec:
    """A body on one strut, without gravity; mass, damping and stiffness in SI units."""
    mass_kg, damping_n_s_per_m, stiffness_n_per_m = constants
    body = BodySpec(name="body", mass_kg=mass_kg, joint=JointSpec(type="prismatic"))
    strut = StrutSpec(
        name="strut",
        between=(WORLD, "body"),
        free_length_m=free_length_m,
        stiffness_n_per_m=stiffness_n_per_m,
        damping_n_s_per_m=damping_n_s_per_m,
    )
    return ModelSpec(
        name=name, gravity_m_per_s2=0.0, skeleton=InlineSkeleton(bodies=(body,)), struts=(strut,)
    )
