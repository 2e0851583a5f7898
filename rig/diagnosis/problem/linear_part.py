"""The linear part of a model: mass, stiffness, damping, preload, gain, free length, never exact.

Each has a prior, from the model file's `tolerance` or a default, which decides only where the data
do not. A change of mass, stiffness and damping in one proportion is indistinguishable from one of
the gain, which is never fitted together with all three.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import Bench, Motion, effect
from dart_model.spec import EffectSpec, InlineSkeleton, ModelSpec
from rig.diagnosis.problem.drive import Drive
from rig.diagnosis.problem.mechanism import LinearisedMechanism
from rig.diagnosis.problem.problem import Kind, LinearParameter, mid_stroke_m
from rig.recordings.recording import RecordingError

Array = NDArray[np.float64]

TOLERANCES = {
    "mass": 0.05, "stiffness": 0.2, "damping": 0.4, "preload": 0.1, "gain": 0.02, "free_length": 0.1
}  # fmt: skip
"""Standard uncertainties where the model file states none, as shares of the nominal value; of the
preload, of what spring and damper give on the motion, and of the free length, of the stroke. A body
can be weighed to a few percent with what moves along with it; springs are sold to 10 % and
installed to 20; dampers vary by 30 % from warm to cold and from piece to piece (Dixon, The Shock
Absorber Handbook, 2007, 9); a load cell in calibration is good to 2 %."""
_LEAST_MASS = 0.1
"""Lowest mass that a correction may leave, as a share of the nominal value. Springs and dampers
may vanish altogether: a law that has a stiffness or damping may replace them."""
_SIGNIFICANT_DIGITS = 12

PARAMETERS = {
    "mass": "mass_kg",
    "stiffness": "stiffness_n_per_m",
    "damping": "damping_n_s_per_m",
    "preload": "preload_n",
    "gain": "input_gain",
    "free_length": "free_length_m",
    "delay": "delay_s",
    "height_gain": "gain",
}
"""Kinds as they are called in a diagnosis and in a model's `tolerance`."""
EFFECTS = {
    "mass": "added_mass",
    "stiffness": "linear_stiffness",
    "damping": "linear_damping",
    "preload": "preload",
    "gain": "input_gain",
    "delay": "delay",
    "height_gain": "input_gain",
}
"""Effects that stand for a change of each."""


def linear_parameters(
    spec: ModelSpec,
    bench: Bench,
    motions: Sequence[Motion],
    mechanism: LinearisedMechanism,
    drive: Drive,
) -> tuple[LinearParameter, ...]:
    """Linear parameters of a model that a bench can show, with their priors.

    Where no force drives the bench, the data determine masses, stiffnesses, dampings and forces of
    laws up to a common factor: the largest moving mass is then not corrected, and sets the scale.
    """
    masses_kg = [motion.mass_kg for motion in motions]
    scale_strut = -1 if drive.has_force else int(np.argmax(masses_kg))
    parameters: list[LinearParameter] = []
    for i, (strut, motion) in enumerate(zip(spec.struts, motions, strict=True)):
        stiffness, damping = strut.stiffness_n_per_m, strut.damping_n_s_per_m
        # A nominal value of zero has no share: the scale is then a large value for the motion.
        force = max(motion.force_n, 1e-300)
        stiffness_scale = stiffness or force / motion.stroke_m
        damping_scale = damping or force / motion.speed_m_per_s
        preload_scale = max(stiffness * motion.stroke_m, force)
        kinds: list[tuple[Kind, float, float, float]] = [
            ("stiffness", stiffness, stiffness_scale, -stiffness),
            ("damping", damping, damping_scale, -damping),
            ("preload", 0.0, preload_scale, -np.inf),
            ("free_length", strut.free_length_m, motion.stroke_m, -np.inf),
        ]
        is_first = all(strut.carried != other.carried for other in spec.struts[:i])
        if bench == "force_given" and i != scale_strut and is_first:
            mass = masses_kg[i]
            kinds.append(("mass", mass, mass, -(1.0 - _LEAST_MASS) * mass))
        parameters += [
            LinearParameter(i, kind, value, _deviation(spec, kind, scale), least)
            for kind, value, scale, least in kinds
        ]
    first_force = drive.first_force
    if (
        bench == "force_given"
        and first_force is not None
        and _along_last_strut(mechanism, first_force)
    ):
        deviation = _deviation(spec, "gain", 1.0)
        parameters.append(
            LinearParameter(len(motions) - 1, "gain", 1.0, deviation, -0.95, first_force)
        )
    return tuple(parameters)


def _deviation(spec: ModelSpec, kind: Kind, scale: float) -> float:
    stated = None if spec.tolerance is None else getattr(spec.tolerance, PARAMETERS[kind])
    if kind in ("preload", "free_length") and stated is not None:
        return float(stated)
    return (TOLERANCES[kind] if stated is None else float(stated)) * scale


def moving_mass_kg(spec: ModelSpec, mechanism: LinearisedMechanism, strut: int) -> float:
    """Mass that a strut's force moves directly: the body that it carries, with all on that.

    Raises:
        RecordingError: No motion depends on that body's mass.
    """
    per_kg = mechanism.mass_by_kg[:, strut].mean(axis=0)
    mass = mechanism.mass.mean(axis=0)
    # Of the coordinates that a kg on this body loads, the one that moves the least other mass:
    # further ones move it together with the bodies below.
    loaded = np.diag(per_kg) > 0.0
    if not loaded.any():
        raise RecordingError(
            f"strut {spec.struts[strut].name}: the mass of {spec.struts[strut].carried} makes no "
            "difference to its motion, expected `carries` to name a body whose mass does"
        )
    return float(np.min(np.diag(mass)[loaded] / np.diag(per_kg)[loaded]))


def _along_last_strut(mechanism: LinearisedMechanism, first_force: int) -> bool:
    """Whether the applied force acts as a force in the last strut would."""
    applied = mechanism.inputs[:, :, first_force]
    return bool(np.allclose(applied, mechanism.jacobian[:, -1], rtol=1e-9, atol=1e-12))


def strut_force(kind: Kind, height_m: Array, velocity_m_per_s: Array, motion: Motion) -> Array:
    """Strut force (N,) of a unit change of stiffness, damping or preload."""
    if kind == "stiffness":
        return -(height_m - mid_stroke_m(motion))
    if kind == "damping":
        return -velocity_m_per_s
    return np.full_like(height_m, 1.0 if kind == "preload" else 0.0)


def with_linear_changes(
    mechanism: LinearisedMechanism, linear: Sequence[LinearParameter], changes: Array
) -> LinearisedMechanism | None:
    """The mechanism with masses and gain changed; None if the mass matrix is not positive."""
    mass, bias, inputs = mechanism.mass, mechanism.bias, mechanism.inputs
    for parameter, change in zip(linear, changes, strict=True):
        if parameter.kind == "mass" and change != 0.0:
            mass = mass + change * mechanism.mass_by_kg[:, parameter.strut]
            bias = bias + change * mechanism.bias_by_kg[:, parameter.strut]
            inputs = inputs + change * mechanism.inputs_by_kg[:, parameter.strut]
        elif parameter.kind == "gain" and change != 0.0:
            inputs = inputs.copy()
            inputs[:, :, parameter.input] *= 1.0 + change
    if float(np.min(np.linalg.eigvalsh(mass[:1]))) <= 0.0:
        return None
    return mechanism._replace(mass=mass, bias=bias, inputs=inputs)


def spec_with_linear_changes(
    spec: ModelSpec, linear: Sequence[LinearParameter], changes: Array, motions: Sequence[Motion]
) -> ModelSpec:
    """The model with its linear part changed: in the field of the file where there is one."""
    for parameter, change in zip(linear, changes, strict=True):
        if change == 0.0:
            continue
        strut = spec.struts[parameter.strut]
        match parameter.kind:
            case "stiffness":
                # About mid-stroke: what the spring then carries at its free length is a preload.
                middle = mid_stroke_m(motions[parameter.strut]) - strut.free_length_m
                spec = _with_field(spec, strut.name, "stiffness_n_per_m", change)
                spec = _with_preload(spec, strut.name, change * middle)
            case "damping" if strut.damping_n_s_per_m + change >= 0.0:
                spec = _with_field(spec, strut.name, "damping_n_s_per_m", change)
            case "preload":
                spec = _with_preload(spec, strut.name, change)
            case "mass":
                spec = _with_mass(spec, strut.name, change)
            case "delay" | "height_gain":
                continue  # Of the measurement.
            case "free_length":
                spec = _with_field(spec, strut.name, "free_length_m", change)
                spec = _with_preload(spec, strut.name, -strut.stiffness_n_per_m * change)
            case _:
                spec = _with_sum(spec, strut.name, EFFECTS[parameter.kind], change)
    return spec


def _with_field(spec: ModelSpec, strut: str, field: str, change: float) -> ModelSpec:
    struts = tuple(
        item.model_copy(update={field: round_for_file(getattr(item, field) + change)})
        if item.name == strut
        else item
        for item in spec.struts
    )
    return spec.model_copy(update={"struts": struts})


def _with_preload(spec: ModelSpec, strut: str, force_n: float) -> ModelSpec:
    return _with_sum(spec, strut, "preload", force_n)


def _with_sum(spec: ModelSpec, strut: str, name: str, change: float) -> ModelSpec:
    """The model with an effect of one parameter added, or increased where it exists already."""
    effects = list(spec.strut(strut).effects)
    for i, item in enumerate(effects):
        if item.name == name:
            ((key, value),) = item.parameters.items()
            effects[i] = EffectSpec(name=name, parameters={key: round_for_file(value + change)})
            return spec.with_effects(strut, effects)
    key = effect(name).parameters[0].name
    new = EffectSpec(name=name, parameters={key: round_for_file(change)})
    return spec.with_effects(strut, (*effects, new))


def _with_mass(spec: ModelSpec, strut: str, change: float) -> ModelSpec:
    """The model with more mass on the body that `added_mass` would load."""
    carried = spec.strut(strut).carried
    if not isinstance(spec.skeleton, InlineSkeleton):
        return _with_sum(spec, strut, "added_mass", change)
    bodies = tuple(
        body.model_copy(update={"mass_kg": round_for_file(body.mass_kg + change)})
        if body.name == carried and body.mass_kg + change > 0.0
        else body
        for body in spec.skeleton.bodies
    )
    skeleton = spec.skeleton.model_copy(update={"bodies": bodies})
    return spec.model_copy(update={"skeleton": skeleton})


def round_for_file(value: float) -> float:
    """A number for a model file, with more digits than any data determine."""
    return float(np.format_float_scientific(value, precision=_SIGNIFICANT_DIGITS))
