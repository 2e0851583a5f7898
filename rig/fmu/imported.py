"""An FMU from elsewhere as a model: a strut's force on a guided body, or a whole guided bench."""

import math
import re
import shutil
from pathlib import Path
from typing import Any

from dart_model.plant import DartPlant
from dart_model.plant.mockup import MockUp, description_of
from dart_model.spec import (
    BodySpec,
    FmuSpec,
    InlineSkeleton,
    JointSpec,
    ModelSpec,
    StrutSpec,
    dump_model,
)
from rig.inputs.errors import InputError
from rig.inputs.folders import refuse_full
from rig.inputs.programs import admit
from rig.inputs.yaml_file import parse_mapping, read_text, validated

MODEL_FILE = "model.yaml"

_FORCES_N = (0.0, 1.0, 1000.0)
"""Applied forces from which the mass of a bench is found."""

_PROPORTIONAL = 1e-6
"""Share by which the mass may depend on the force."""


def import_fmu(source: Path, mapping: Path | None, mass_kg: float | None, out: Path) -> ModelSpec:
    """Make a model of an FMU, which from then on may run on this machine.

    Args:
        source: The FMU.
        mapping: What its variables are, as in the `fmu` of a model file; without it, they are
            called as in an FMU of `rig export`.
        mass_kg: Mass that the strut carries; of a bench it is found.
        out: New folder for the model file and the FMU.

    Returns:
        The model.

    Raises:
        InputError: The FMU, the mapping or the folder is wrong, or a mass is missing.
    """
    refuse_full(out)
    description = description_of(source)
    roles = _mapped(mapping, source) if mapping is not None else _named(description, source)
    is_bench = roles.acceleration is not None
    if is_bench and mass_kg is not None:
        raise InputError("--mass-kg: expected none, a bench has its own")
    if not is_bench and mass_kg is None:
        raise InputError(f"{source}: a strut alone, expected --mass-kg with what it carries")
    admit(source)
    if is_bench:
        mass_kg = _mass_kg(source, roles)
        roles = roles.model_copy(update={"mass_kg": mass_kg})
    spec = _model(description, roles, mass_kg or math.nan, source)
    DartPlant(spec)
    try:
        out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, out / source.name)
        (out / MODEL_FILE).write_text(dump_model(spec), "utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return spec.model_copy(update={"folder": out})


def _mapped(mapping: Path, source: Path) -> FmuSpec:
    given = parse_mapping(read_text(mapping), str(mapping))
    return validated(FmuSpec, {**given, "file": source.name}, str(mapping))


def _named(description: Any, source: Path) -> FmuSpec:
    """What the variables of an FMU of ours are."""
    causality = {item.name: item.causality for item in description.modelVariables}

    def there(name: str) -> str | None:
        return name if causality.get(name) == "input" else None

    further = {"temperature": there("temperature_c"), "applied_force": there("applied_force_n")}
    if there("height_m") and there("velocity_m_per_s") and causality.get("force_n") == "output":
        own = {"height": "height_m", "velocity": "velocity_m_per_s", "force": "force_n"}
        return FmuSpec.model_validate({"file": source.name, **own, **further})
    rates = {item.variable.derivative.name: item.variable.name for item in description.derivatives}
    found = [name.removesuffix("height_m") for name in rates if name.endswith(".height_m")]
    for prefix in found:
        height, velocity = f"{prefix}height_m", f"{prefix}velocity_m_per_s"
        if velocity in rates and further["applied_force"]:
            own = {"height": height, "velocity": velocity, "acceleration": rates[velocity]}
            return FmuSpec.model_validate({"file": source.name, **own, **further})
    names = ", ".join(n for n, kind in causality.items() if kind in ("input", "output"))
    raise InputError(
        f"{source}: its variables are not named as ours, expected --mapping FILE that says which "
        f"are height, velocity and force (it has {names[:300]})"
    )


def _mass_kg(source: Path, roles: FmuSpec) -> float:
    """Mass of a bench along its height: force over acceleration."""
    if roles.applied_force is None:
        raise InputError(f"{source}: a bench without applied_force, expected the input that it is")
    # With a mass of 1 kg and no gravity, what it gives is the acceleration less the applied force.
    unit = MockUp(roles.model_copy(update={"mass_kg": 1.0}), source.parent, 0.0)
    rest = [0.0] * len(unit.state_scales)
    given = [unit.force(0.0, 0.0, 0.0, force_n, 20.0, rest) + force_n for force_n in _FORCES_N]
    slopes = [(a - given[0]) / force_n for a, force_n in zip(given[1:], _FORCES_N[1:], strict=True)]
    if not (slopes[0] > 0.0 and math.isclose(*slopes, rel_tol=_PROPORTIONAL)):
        raise InputError(
            f"{source}: an applied force of 1 N and of 1000 N accelerates by {slopes[0]:.6g} and "
            f"{slopes[1]:.6g} m/s² per newton, expected a mass on a straight guide"
        )
    return float(f"{1.0 / slopes[0]:.12g}")


def _model(description: Any, roles: FmuSpec, mass_kg: float, source: Path) -> ModelSpec:
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", description.modelName or "fmu")[:60]
    starts = {item.name: item.start for item in description.modelVariables}
    start = starts.get(roles.height.removeprefix("-")) or 0.0
    sign = -1.0 if roles.height.startswith("-") else 1.0
    strut = StrutSpec(
        name="strut",
        between=("world", "body"),
        free_length_m=sign * float(start),
        stiffness_n_per_m=0.0,
        damping_n_s_per_m=0.0,
        fmu=roles,
    )
    body = BodySpec(name="body", mass_kg=mass_kg, joint=JointSpec(type="prismatic"))
    return ModelSpec(
        name=name if re.match(r"[A-Za-z_]", name) else f"fmu_{name}"[:60],
        skeleton=InlineSkeleton(bodies=(body,)),
        struts=(strut,),
        folder=source.parent,
    )
