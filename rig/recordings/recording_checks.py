"""What is wrong with a recording that would mislead, in one line, before anything is computed."""

from collections.abc import Iterable

import numpy as np

from can_dbc.errors import expected_name
from dart_model.spec import ForceInput, ModelSpec
from rig.channels.measured_quantities import ACCELERATION, APPLIED_FORCE, quantity_of
from rig.recordings.clipping import find_long_plateaus
from rig.recordings.recording import Array, RecordedInput, Recording, RecordingError

_LEAST_SAMPLES = 200
"""The shortest recording, half a second, at 400 Hz."""
_LEAST_DURATION_S = 0.5
_LARGEST_HEIGHT_M = 100.0
"""No strut is as long: a height beyond it is in mm, or another column."""
_LONGEST_DURATION_S = 600.0
"""A longer recording adds nothing about a strut, and takes minutes."""
_MOST_MISSING = 0.3
"""Share of missing heights above which a sensor is taken for broken."""
_LONGEST_STEP_S = 0.05
"""Usual time between samples above which a time in other units is more likely."""


def check_recording(recording: Recording) -> Recording:
    """The recording itself; single missing heights are allowed.

    Raises:
        RecordingError: Its data would mislead: clipped, constant, in wrong units, too short.
    """
    name, t_s = recording.name, recording.t_s
    if len(t_s) < _LEAST_SAMPLES:
        raise RecordingError(
            f"{name}: {len(t_s)} samples, expected at least {_LEAST_SAMPLES}: record a longer run"
        )
    _check_times(name, t_s)
    for height_m in recording.heights_m.T:
        _check_height(name, height_m)
    for label, channel, advice in _channels(recording):
        bad = ~np.isfinite(channel)
        if np.any(bad):
            raise RecordingError(
                f"{name}: {label} is no number in {int(bad.sum())} samples, first in sample "
                f"{int(np.argmax(bad))}, expected numbers"
            )
        if advice and float(np.ptp(channel)) == 0.0:
            raise RecordingError(
                f"{name}: {label} is constant at {channel[0]:.6g}, expected it to change: {advice}"
            )
        if label == "strut_force_n":
            _refuse_clipping(name, label, "N", channel)
    return recording


def check_fits(recording: Recording, spec: ModelSpec) -> None:
    """Refuse a recording that does not belong to a model, or that misleads, see `check_recording`.

    Raises:
        RecordingError: See above.
    """
    check_recording(recording)
    struts = len(spec.struts)
    if recording.heights_m.shape[1] != struts:
        raise RecordingError(
            f"{recording.name}: {recording.heights_m.shape[1]} height(s), but model {spec.name} "
            f"has {struts} strut(s), expected one height for each: is it the model of this run?"
        )
    if recording.inputs:
        inputs_of(recording, spec)
    if recording.duration_s > _LONGEST_DURATION_S:
        raise RecordingError(
            f"{recording.name}: {recording.duration_s:.0f} s long, "
            f"expected at most {_LONGEST_DURATION_S:.0f} s: cut it"
        )


def inputs_of(recording: Recording, spec: ModelSpec) -> dict[str, RecordedInput]:
    """What drove a recording, by the names of a model's inputs and in their order.

    Raises:
        RecordingError: They are not those of the model.
    """
    given, inputs = dict(recording.inputs), dict[str, RecordedInput]()
    forces = [name for name, item in spec.drive.items() if isinstance(item, ForceInput)]
    if APPLIED_FORCE.key in given and APPLIED_FORCE.key not in spec.drive and len(forces) == 1:
        given[forces[0]] = given.pop(APPLIED_FORCE.key)
    for name, item in spec.drive.items():
        quantity = quantity_of(item)
        if name not in given or given[name].quantity is not quantity:
            column = quantity.column if spec.inputs is None else f"{quantity.column}:{name}"
            raise RecordingError(
                f"{recording.name}: expected a column {column}, because model {spec.name} has this "
                "input"
            )
        inputs[name] = given.pop(name)
    for name, other in given.items():
        raise RecordingError(
            f"{recording.name}: column {other.quantity.column}:{name}: model {spec.name} has no "
            f"such input, {expected_name(name, list(spec.drive))}"
        )
    return inputs


def _channels(recording: Recording) -> Iterable[tuple[str, Array, str]]:
    for name, item in recording.inputs.items():
        label = item.quantity.column
        if name != item.quantity.key:
            label += f":{name}"
        # One of several may rest.
        advice = "drive the bench with it" if len(recording.inputs) == 1 else ""
        yield label, item.values, advice
        if item.acceleration_m_per_s2 is not None:
            yield f"{ACCELERATION.column}:{name}", item.acceleration_m_per_s2, ""
    if recording.strut_forces_n is not None:
        for column in recording.strut_forces_n.T:
            if not np.all(np.isnan(column)):
                yield "strut_force_n", column, "is the load cell connected?"
    if recording.temperature_c is not None:
        yield "temperature_c", recording.temperature_c, ""


def _check_times(name: str, t_s: Array) -> None:
    if not np.all(np.isfinite(t_s)):
        row = int(np.argmin(np.isfinite(t_s)))
        raise RecordingError(f"{name}: t_s is no number in sample {row}, expected a time in s")
    steps = np.diff(t_s)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise RecordingError(
            f"{name}: t_s = {t_s[row]:.6g} in sample {row} after {t_s[row - 1]:.6g}, "
            "expected times that increase"
        )
    if t_s[-1] - t_s[0] < _LEAST_DURATION_S:
        raise RecordingError(
            f"{name}: t_s spans {t_s[-1] - t_s[0]:.3g} s, "
            f"expected at least {_LEAST_DURATION_S} s: is the time in s?"
        )
    usual = float(np.median(steps))
    if usual > _LONGEST_STEP_S:
        raise RecordingError(
            f"{name}: t_s has one sample in {usual:.3g} s, expected "
            f"{1.0 / _LONGEST_STEP_S:.0f} a second or more: is the time in s?"
        )


def _check_height(name: str, height_m: Array) -> None:
    finite = np.isfinite(height_m)
    if np.any(np.isinf(height_m)) or float(np.mean(~finite)) > _MOST_MISSING:
        raise RecordingError(
            f"{name}: height_m is no number in {int((~finite).sum())} of {len(finite)} samples, "
            f"expected at most {100.0 * _MOST_MISSING:.0f} % missing"
        )
    heights = height_m[finite]
    if float(np.max(np.abs(heights))) > _LARGEST_HEIGHT_M:
        raise RecordingError(
            f"{name}: height_m reaches {np.max(np.abs(heights)):.6g} m, expected less than "
            f"{_LARGEST_HEIGHT_M:g} m: are the columns swapped, or the unit wrong?"
        )
    if float(np.ptp(heights)) == 0.0:
        raise RecordingError(
            f"{name}: height_m is constant at {heights[0]:.6g} m, "
            "expected motion: is the sensor connected?"
        )
    _refuse_clipping(name, "height_m", "m", heights)


def _refuse_clipping(name: str, label: str, unit: str, values: Array) -> None:
    plateaus = find_long_plateaus(values)
    if plateaus is not None:
        raise RecordingError(
            f"{name}: {label} stays at its {plateaus.extreme} value {plateaus.limit:.6g} {unit} "
            f"for {int(np.max(plateaus.lengths))} samples in a row, expected a sensor that is not "
            "clipped: widen its range or reduce the load"
        )
