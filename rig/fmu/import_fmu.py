"""An FMU from elsewhere as a model: a strut's force on a guided body, or a whole guided bench."""

import math
import re
import tempfile
from pathlib import Path
from typing import Any

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text, validate
from dart_model.effects import AMBIENT_C
from dart_model.plant import DartPlant
from dart_model.plant.admitted_programs import admit, withdraw
from dart_model.plant.fmu import MockUp, read_description, read_program
from dart_model.spec import FmuSpec, ModelSpec, dump_model
from rig.files.folders import refuse_full

MODEL_FILE, FMU_FILE = "model.yaml", "strut.fmu"

_FORCES_N = (0.0, 1.0, 1000.0)
"""Applied forces from which the mass of a bench is computed."""

_PROPORTIONAL = 1e-6
"""Share by which the mass may depend on the force."""


def import_fmu(source: Path, mapping: Path | None, mass_kg: float | None, out: Path) -> ModelSpec:
    """Make a model of an FMU, which from then on may run on this machine.

    The file `mapping` gives the roles of its variables, as in the `fmu` of a model file; without
    it, they are called as in an FMU of `rig export`. The mass is what the strut carries; of a bench
    it is computed if it is None. The model file and the FMU are written into the new folder `out`.

    Raises:
        InputError: The FMU, the mapping or the folder is wrong, or a mass is missing.
    """
    if mass_kg is not None and not 0.0 < mass_kg < math.inf:
        raise InputError(f"--mass-kg {mass_kg}: expected a number above zero")
    refuse_full(out)
    content = read_program(source)
    description = read_description(content, source)
    if mapping is None:
        roles = _roles_by_name(description, source)
    else:
        given = parse_mapping(read_text(mapping), str(mapping))
        roles = validate(FmuSpec, {**given, "file": FMU_FILE}, str(mapping))
    _refuse_contradictions(roles, mapping or source)
    if roles.force is not None and mass_kg is None:
        raise InputError(f"{source}: a strut alone, expected --mass-kg with what it carries")
    is_new = admit(content)
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / FMU_FILE).write_bytes(content)
            spec = _model(description, roles, mass_kg, folder, source)
            DartPlant(spec)
    except BaseException:
        if is_new:
            withdraw(content)
        raise
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / FMU_FILE).write_bytes(content)
        (out / MODEL_FILE).write_text(dump_model(spec), "utf-8")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return spec.model_copy(update={"folder": out})


def variables_of(roles: FmuSpec) -> dict[str, str]:
    """Variable of each role that the FMU has."""
    keys = ("height", "velocity", "force", "acceleration", "temperature", "applied_force")
    return {key: name for key in keys if (name := getattr(roles, key)) is not None}


def _refuse_contradictions(roles: FmuSpec, source: Path) -> None:
    variables = variables_of(roles)
    plain = [name.removeprefix("-") for name in variables.values()]
    if len(set(plain)) < len(plain):
        raise InputError(f"{source}: one variable has two roles, expected one for each")
    motion = [variables.get(key, roles.height) for key in ("height", "velocity", "acceleration")]
    if len({name.startswith("-") for name in motion}) > 1:
        raise InputError(
            f"{source}: height, velocity and acceleration have different signs, expected one"
        )


def _roles_by_name(description: Any, source: Path) -> FmuSpec:
    """Roles of the variables of an FMU of `rig export`, by their names."""
    causality = {item.name: item.causality for item in description.modelVariables}

    def find_input(name: str) -> str | None:
        return name if causality.get(name) == "input" else None

    further = {
        "temperature": find_input("temperature_c"),
        "applied_force": find_input("applied_force_n"),
    }
    if (
        find_input("height_m")
        and find_input("velocity_m_per_s")
        and causality.get("force_n") == "output"
    ):
        own = {"height": "height_m", "velocity": "velocity_m_per_s", "force": "force_n"}
        return validate(FmuSpec, {"file": FMU_FILE, **own, **further}, str(source))
    rates = {item.variable.derivative.name: item.variable.name for item in description.derivatives}
    for height in rates:
        velocity = height.removesuffix("height_m") + "velocity_m_per_s"
        if height.endswith(".height_m") and velocity in rates and further["applied_force"]:
            own = {"height": height, "velocity": velocity, "acceleration": rates[velocity]}
            return validate(FmuSpec, {"file": FMU_FILE, **own, **further}, str(source))
    names = ", ".join(n for n, kind in causality.items() if kind in ("input", "output"))
    raise InputError(
        f"{source}: its variables have other names than those of `rig export`, expected --mapping "
        f"FILE that gives height, velocity and force (it has {names[:300]})"
    )


def _mass_kg(roles: FmuSpec, description: Any, folder: Path, source: Path) -> float:
    """Mass of a bench along its height: force over acceleration.

    In an FMU of `rig export` the strut's force counts too, because an effect may depend on the
    applied force.
    """
    if roles.applied_force is None:
        raise InputError(f"{source}: a bench without applied_force, expected it or --mass-kg")
    own = f"{roles.height.removesuffix('height_m')}force_n"
    is_exported = roles.height.endswith(".height_m") and own in {
        item.name for item in description.modelVariables
    }
    # With a mass of 1 kg and no gravity, its force is the acceleration less the applied force.
    unit = MockUp(roles.model_copy(update={"mass_kg": 1.0}), folder, 0.0)
    rest = [0.0] * len(unit.state_scales)
    accelerations = [unit.force(0.0, 0.0, 0.0, f, AMBIENT_C, rest) + f for f in _FORCES_N]
    forces = list(_FORCES_N)
    if is_exported:
        update = {"force": own, "acceleration": None}
        strut = MockUp(roles.model_copy(update=update), folder, 0.0)
        forces = [f + strut.force(0.0, 0.0, 0.0, f, AMBIENT_C, rest) for f in _FORCES_N]
    masses = [
        (force - forces[0]) / (a - accelerations[0]) if a != accelerations[0] else math.nan
        for force, a in zip(forces[1:], accelerations[1:], strict=True)
    ]
    if not (masses[0] > 0.0 and math.isclose(*masses, rel_tol=_PROPORTIONAL)):
        raise InputError(
            f"{source}: applied forces of 1 N and of 1000 N give masses of {masses[0]:.6g} and "
            f"{masses[1]:.6g} kg, expected one on a straight guide, or --mass-kg"
        )
    return float(f"{masses[0]:.12g}")


def _model(
    description: Any, roles: FmuSpec, mass_kg: float | None, folder: Path, source: Path
) -> ModelSpec:
    if mass_kg is None:
        mass_kg = _mass_kg(roles, description, folder, source)
    if roles.acceleration is not None:
        roles = roles.model_copy(update={"mass_kg": mass_kg})
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", description.modelName or "fmu")[:60]
    strut = {
        "name": "strut",
        "between": ("world", "body"),
        "free_length_m": _start_m(description, roles.height),
        "stiffness_n_per_m": 0.0,
        "damping_n_s_per_m": 0.0,
        "fmu": roles.model_dump(exclude_none=True),
    }
    body = {"name": "body", "mass_kg": mass_kg, "joint": {"type": "prismatic"}}
    spec = {
        "name": name if re.match(r"[A-Za-z_]", name) else f"fmu_{name}"[:60],
        "skeleton": {"bodies": [body]},
        "struts": [strut],
    }
    return validate(ModelSpec, spec, str(source)).model_copy(update={"folder": folder})


def _start_m(description: Any, height: str) -> float:
    """Height at which the FMU begins, m; zero if it has no start value."""
    starts = {item.name: item.start for item in description.modelVariables}
    try:
        start = float(starts.get(height.removeprefix("-")) or 0.0)
    except (TypeError, ValueError):
        return 0.0
    if not math.isfinite(start):
        return 0.0
    return -start if height.startswith("-") else start
