"""What an FMU of a strut or of a bench has: its variables, and the C that computes them.

A strut is a force element: motion in, force out. A bench of one guided degree of freedom has the
equation of motion as well, with the mass and the levers that DART has for it.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import numpy as np

from can_dbc.errors import InputError
from dart_model.effects import AMBIENT_C, Effect, effect
from dart_model.effects.calling import STRUT, Origin, arguments
from dart_model.effects.law import Force, Rate
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec, StrutSpec
from dart_model.virtual_sensors import KINDS as SENSOR_KINDS
from dart_model.virtual_sensors import VirtualSensor
from rig.fmu.law_in_c import InC, in_c

Kind = Literal["time", "input", "parameter", "fixed", "state", "rate", "output", "indicator"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Of variables, in the order in which they lie in memory; `parameter` may be tuned in a run."""

LONGEST_STEP = "longest_step_s"

_STRUT_STEP_S = 0.5e-3
"""Longest step of an element's internal states where the speed of the motion is not known: that
of a strut whose motion is prescribed (`dart_model.plant.prescribed_strut`)."""

_SAME = 1e-9
"""Share by which mass or weight may differ between configurations of one guided degree."""


class Variable(NamedTuple):
    """A value of an FMU.

    Attributes:
        start: Its value at the beginning, if it is declared.
        nominal: Its usual size.
        is_output: Whether a state is an output as well.
    """

    name: str
    unit: str
    kind: Kind
    meaning: str
    start: float | None = None
    nominal: float = 1.0
    is_output: bool = False


@dataclass(frozen=True)
class Component:
    """An FMU without its wrapping.

    Attributes:
        identifier: The same as a C identifier, and as the name of the file.
        meaning: What it is, in a sentence or two.
        variables: All variables, in the order of `KINDS`; a value reference is an index into it.
        evaluation: C of the body of `model_evaluate`.
    """

    name: str
    identifier: str
    meaning: str
    variables: tuple[Variable, ...]
    laws: str
    evaluation: str

    def of(self, kind: Kind) -> list[tuple[int, Variable]]:
        """Variables of one kind, each behind its value reference."""
        return [(k, item) for k, item in enumerate(self.variables) if item.kind == kind]


def strut_component(spec: ModelSpec, strut: StrutSpec) -> Component:
    """A strut as a force element."""
    made = _Build()
    made.add("height_m", "m", "input", "height of the strut", strut.free_length_m)
    made.add("velocity_m_per_s", "m/s", "input", "its derivative; positive is rebound", 0.0)
    made.add("temperature_c", "degC", "input", "temperature of the damper", AMBIENT_C)
    effects, text = made.strut(strut, "", spec.gravity_m_per_s2)
    if any("applied_force_n" in _argument_names(law) for law, _ in effects):
        made.add("applied_force_n", "N", "input", "force that is applied to the bench", 0.0)
    made.add(LONGEST_STEP, "s", "fixed", "longest step of co-simulation", _STRUT_STEP_S)
    carried = [law.words for law, _ in effects if law.adds_mass]
    meaning = (
        f"Strut {strut.name} of {spec.name}: force over height, velocity and temperature, positive "
        "when it pushes the two bodies apart."
    )
    if carried:
        meaning += (
            f" Not in the force: {', '.join(carried)}; add the mass, with its weight, to the body "
            "that the strut carries."
        )
    return made.component(spec.name, f"{spec.name}_{strut.name}", meaning, text)


def bench_component(
    spec: ModelSpec, sensors: Mapping[str, VirtualSensor] = MappingProxyType({})
) -> Component:
    """A bench of one guided degree of freedom, with its struts and with virtual sensors.

    Raises:
        InputError: The model has more degrees of freedom, or one that is not guided along a line;
            or a sensor reads what the model does not have.
    """
    guide = _guide(spec, sensors)
    made = _Build()
    made.add("applied_force_n", "N", "input", "applied force", 0.0)
    made.add("temperature_c", "degC", "input", "temperature of the damper", AMBIENT_C)
    made.add("mass_kg", "kg", "parameter", "mass that moves with the first strut", guide.mass_kg)
    g = spec.gravity_m_per_s2
    made.add("gravity_m_per_s2", "m/s2", "parameter", "standard gravity", g)
    made.add(LONGEST_STEP, "s", "fixed", "longest step of co-simulation", guide.longest_step_s)
    first = f"{_identifier(spec.struts[0].name)}."
    height, velocity = first + "height_m", first + "velocity_m_per_s"
    rest = guide.rest_height_m
    made.add(height, "m", "state", "height of the strut", rest, is_output=True)
    made.add(velocity, "m/s", "state", "its derivative; positive is rebound", 0.0, is_output=True)
    made.add(f"der({height})", "m/s", "rate", "derivative of the height")
    made.add(f"der({velocity})", "m/s2", "rate", "second derivative of the height")
    added = iter(guide.added)
    text: list[str] = []
    forces: list[str] = []
    masses = [_ref("mass_kg")]
    weights = [f"{guide.weight_n_per_kg!r} * {_ref('mass_kg')}"]
    for strut, ratio, offset_m in zip(spec.struts, guide.ratios, guide.offsets_m, strict=True):
        prefix = f"{_identifier(strut.name)}."
        if prefix != first:
            made.add(prefix + "height_m", "m", "output", "height of the strut")
            made.add(prefix + "velocity_m_per_s", "m/s", "output", "positive is rebound")
            for name, zero_m in (("height_m", offset_m), ("velocity_m_per_s", 0.0)):
                state = _ref(first + name)
                text.append(f"{_ref(prefix + name)} = {zero_m!r} + {ratio!r} * {state};")
        effects, laws = made.strut(strut, prefix, None)
        text.append(laws)
        forces.append(f"{ratio!r} * {_ref(prefix + 'force_n')}")
        for law, own_prefix in effects:
            if law.adds_mass:
                mass = _ref(own_prefix + law.parameters[0].name)
                inertia, weight_n_per_kg = next(added)
                masses.append(f"{inertia!r} * {mass}")
                weights.append(f"{weight_n_per_kg!r} * {mass}")
    applied = f"{guide.applied!r} * {_ref('applied_force_n')}"
    weight = f"{_ref('gravity_m_per_s2')} * ({' + '.join(weights)})"
    total = " + ".join([applied, *forces, weight])
    text.append(f"{_ref(f'der({height})')} = {_ref(velocity)};")
    text.append(f"{_ref(f'der({velocity})')} = ({total}) / ({' + '.join(masses)});")
    for (name, item), row in zip(sensors.items(), guide.sensors, strict=True):
        quantity = item.quantity(is_turning=False)
        unit = quantity.dimension.value.replace("^", "").replace("*", ".")
        variable = f"{_identifier(name)}.{quantity.suffix}"
        made.add(variable, unit, "output", f"{quantity.meaning}: {item.target}")
        numbers = [
            _ref(height),
            _ref(velocity),
            _ref(f"der({velocity})"),
            *(_ref(f"{_identifier(strut.name)}.force_n") for strut in spec.struts),
            _ref("applied_force_n"),
            "1.0",
        ]
        terms = [f"{share!r} * {number}" for share, number in zip(row, numbers, strict=True)]
        text.append(f"{_ref(variable)} = {' + '.join(terms)};")
    meaning = (
        f"Bench {spec.name}: one guided degree of freedom under an applied force, which is "
        "positive upwards. Strut forces are positive when they push the two bodies apart."
    )
    return made.component(spec.name, f"{spec.name}_bench", meaning, "\n".join(text))


_References = Mapping[Origin, Sequence[str]]
"""References to the variables behind a law's arguments, by their origin."""


def _ref(name: str) -> str:
    """A reference to a variable in C, until its index is known."""
    return f"[<{name}>]"


class _Build:
    """Variables and laws as they come together; references are to names until all are known."""

    def __init__(self) -> None:
        self._variables: dict[str, Variable] = {}
        self._laws: dict[str, InC] = {}
        self._indicators = 0
        self.add("time", "s", "time", "time", None)

    def add(
        self,
        name: str,
        unit: str,
        kind: Kind,
        meaning: str,
        start: float | None = None,
        nominal: float = 1.0,
        *,
        is_output: bool = False,
    ) -> None:
        """Add a variable."""
        if name in self._variables:
            raise InputError(f"{name}: two variables of this name, expected other names")
        self._variables[name] = Variable(name, unit, kind, meaning, start, nominal, is_output)

    def strut(
        self, spec: StrutSpec, prefix: str, gravity_m_per_s2: float | None
    ) -> tuple[list[tuple[Effect, str]], str]:
        """Add a strut; returns its effects, with prefixes of their names, and C that evaluates it.

        Gravity is a separate parameter unless it is None: a bench has it already.
        """
        add = self.add
        add(prefix + "free_length_m", "m", "parameter", "height without force", spec.free_length_m)
        stiffness, damping = spec.stiffness_n_per_m, spec.damping_n_s_per_m
        add(prefix + "stiffness_n_per_m", "N/m", "parameter", "linear stiffness", stiffness)
        add(prefix + "damping_n_s_per_m", "N.s/m", "parameter", "linear damping", damping)
        if gravity_m_per_s2 is not None:
            add("gravity_m_per_s2", "m/s2", "parameter", "standard gravity", gravity_m_per_s2)
        add(prefix + "force_n", "N", "output", "force of the strut")
        add(prefix + "spring.part_n", "N", "output", "part of the linear spring")
        add(prefix + "damper.part_n", "N", "output", "part of the linear damper")
        items = [
            (effect(item.name), prefix + name)
            for item, name in zip(spec.effects, _own_names(spec.effects), strict=True)
        ]
        constants = [_ref(prefix + name) for name in STRUT[:-1]] + [_ref("gravity_m_per_s2")]
        free_length, stiffness, damping = constants[:-1]
        spring = f"{stiffness} * ({free_length} - height_m)"
        damper = f"{damping} * velocity_m_per_s"
        lines = [
            "{",
            f"    const double height_m = {_ref(prefix + 'height_m')};",
            f"    const double velocity_m_per_s = {_ref(prefix + 'velocity_m_per_s')};",
            f"    double force = {spring} - {damper};",
            f"    {_ref(prefix + 'spring.part_n')} = {spring};",
            f"    {_ref(prefix + 'damper.part_n')} = -{damper};",
        ]
        for item, values in zip(items, spec.effects, strict=True):
            lines += self._effect(*item, values, constants)
        lines += [f"    {_ref(prefix + 'force_n')} = force;", "}"]
        return items, "\n".join(lines)

    def _effect(
        self, law: Effect, prefix: str, values: EffectSpec, constants: Sequence[str]
    ) -> list[str]:
        for parameter, value in zip(law.parameters, values.values(), strict=True):
            unit = _plain_unit(parameter.unit)
            self.add(prefix + parameter.name, unit, "parameter", parameter.meaning, value)
        self.add(prefix + "part_n", "N", "output", f"part of {law.words}")
        states = [f"{prefix}state_{k + 1}" for k in range(law.state_size)]
        for name, scale in zip(states, law.state_scales, strict=True):
            self.add(name, "", "state", f"internal state of {law.words}", 0.0, scale)
            self.add(f"der({name})", "", "rate", "its derivative")
        references: _References = {
            "states": [_ref(name) for name in states],
            "parameters": [_ref(prefix + parameter.name) for parameter in law.parameters],
            "strut": constants,
            "rates": [_ref(f"der({name})") for name in states],
        }
        force, call = self._call(law.name, law.force, law, references)
        lines = [
            *self._switches(force.switches),
            f"        const double part = {call};",
            "        force += part;",
            f"        {_ref(prefix + 'part_n')} = part;",
            "    }",
        ]
        if law.rate is not None:
            rate, call = self._call(f"{law.name}_rate", law.rate, law, references)
            result = "" if rate.writes else f"{references['rates'][0]} = "
            lines += [*self._switches(rate.switches), f"        {result}{call};", "    }"]
        return lines

    def _call(
        self, name: str, function: Force | Rate, law: Effect, references: _References
    ) -> tuple[InC, str]:
        """A law, translated once, and its call with the variables of a strut."""
        if name not in self._laws:
            self._laws[name] = in_c(function, name)
        given = ["&s"]
        for item in arguments(function, law):
            if item.origin == "motion":
                given.append(item.name)
            elif item.origin != "rates":
                row = "" if item.size is None else "&"
                given.append(f"{row}{references[item.origin][item.first]}")
        if self._laws[name].writes:
            given.append(f"&{references['rates'][0]}")
        return self._laws[name], f"{name}({', '.join(given)})"

    def _switches(self, count: int) -> list[str]:
        """The beginning of a block whose law has a number of switches."""
        first = self._indicators
        self._indicators += count
        for k in range(first, self._indicators):
            meaning = "changes its sign where a law switches"
            self.add(f"switches.indicator_{k + 1}", "", "indicator", meaning)
        first_of_block = f"{{is_held, answer + {first}, value + FIRST_INDICATOR + {first}}}"
        return ["    {", f"        const Switches s = {first_of_block};"]

    def component(self, name: str, identifier: str, meaning: str, text: str) -> Component:
        """The component, with references replaced by indices of values."""
        variables = tuple(
            item for kind in KINDS for item in self._variables.values() if item.kind == kind
        )
        indices = {item.name: k for k, item in enumerate(variables)}
        force = f"value[{indices['applied_force_n']}]" if "applied_force_n" in indices else "0.0"
        head = [
            "const double t_s = value[0];",
            f"const double temperature_c = value[{indices['temperature_c']}];",
            f"const double applied_force_n = {force};",
            "(void)t_s; (void)temperature_c; (void)applied_force_n; (void)is_held;",
        ]

        def value(reference: re.Match[str]) -> str:
            return f"value[{indices[reference[1]]}]"

        body = re.sub(r"\[<([^<>]*)>\]", value, "\n".join([*head, text]))
        laws = "\n".join(law.text for law in self._laws.values())
        return Component(name, _identifier(identifier), meaning, variables, laws, body)


def _argument_names(law: Effect) -> set[str]:
    """Names of the arguments of its force and its rate."""
    functions = [law.force] if law.rate is None else [law.force, law.rate]
    return {item.name for function in functions for item in arguments(function, law)}


class _Guide(NamedTuple):
    """The equation of motion along the height of the first strut.

    Attributes:
        mass_kg: Mass, without that of effects.
        weight_n_per_kg: Weight per mass, for a gravity of one; -1 for a vertical guide.
        added: Of each effect with a mass, strut after strut: per kilogram the mass in parallel
            with the first strut, and the force along it for a gravity of one.
        applied: Force along the height per newton of applied force.
        ratios: Travel of each strut per travel of the first one.
        offsets_m: Height of each strut where the first one's is zero.
        rest_height_m: Height of the first strut at rest.
        longest_step_s: Longest step of the model's integrator.
        sensors: Of each virtual sensor the shares of the first strut's height, its two derivatives,
            the forces of the struts, the applied force, and one.
    """

    mass_kg: float
    weight_n_per_kg: float
    added: list[tuple[float, float]]
    applied: float
    ratios: list[float]
    offsets_m: list[float]
    rest_height_m: float
    longest_step_s: float
    sensors: list[list[float]]


def _guide(spec: ModelSpec, sensors: Mapping[str, VirtualSensor]) -> _Guide:
    plant = DartPlant(spec)
    if plant.coordinates != 1 or plant.inputs != 1 or not plant.is_constant:
        raise InputError(
            f"model {spec.name}: {plant.coordinates} joint coordinates, expected one on a straight "
            "guide for a bench as an FMU (a strut alone can always be exported)"
        )
    count = sum(effect(item.name).adds_mass for strut in spec.struts for item in strut.effects)
    mass_kg, weight = _along_height(spec, [0.0] * count)
    added: list[tuple[float, float]] = []
    for k in range(count):
        more_kg, more = _along_height(spec, [float(k == other) for other in range(count)])
        added.append((more_kg - mass_kg, more - weight))
    jacobians = plant.jacobians(np.zeros(1))
    rows, offsets = jacobians.struts[:, 0], jacobians.offsets_m
    ratios = rows / rows[0]
    rest = plant.init([float("nan")] * len(spec.struts))
    return _Guide(
        mass_kg,
        weight / mass_kg,
        added,
        float(jacobians.inputs[0, 0] / rows[0]),
        ratios.tolist(),
        (offsets - ratios * offsets[0]).tolist(),
        rest.struts[0][0],
        plant.step_s,
        _sensor_rows(spec, plant, sensors, float(rows[0]), float(offsets[0])),
    )


def _sensor_rows(
    spec: ModelSpec,
    plant: DartPlant,
    sensors: Mapping[str, VirtualSensor],
    row: float,
    offset_m: float,
) -> list[list[float]]:
    """Shares of what virtual sensors read, as of `_Guide`; ``height = offset + row * q``."""
    for name, item in sensors.items():
        if SENSOR_KINDS[item.kind].of == "strut":
            raise InputError(
                f"--add {name}: {item.kind} {item.target!r}: the FMU has outputs of the struts "
                "already, expected a body or a joint"
            )
    affine = plant.virtual_sensors(sensors).affine if sensors else None
    if affine is None:
        if sensors:
            raise InputError(
                f"model {spec.name}: --add: expected sensors that are linear in the motion"
            )
        return []
    found: list[list[float]] = []
    for position, velocity, acceleration, *others, constant in affine.tolist():
        # Behind the struts' forces and the applied one: forces that only an observer adds.
        forces = others[: len(spec.struts) + 1]
        by_height = [it / row for it in (position, velocity, acceleration)]
        found.append([*by_height, *forces, constant - position * offset_m / row])
    return found


def _along_height(spec: ModelSpec, masses_kg: Sequence[float]) -> tuple[float, float]:
    """Mass, and weight for a gravity of one, along the first strut's height.

    The masses are those of each effect that has one, strut after strut.
    """
    given = iter(masses_kg)
    struts: list[StrutSpec] = []
    for strut in spec.struts:
        effects: list[EffectSpec] = []
        for item in strut.effects:
            parameters = dict(item.parameters)
            if effect(item.name).adds_mass:
                parameters[effect(item.name).parameters[0].name] = next(given)
            effects.append(EffectSpec(name=item.name, parameters=parameters))
        struts.append(strut.model_copy(update={"effects": tuple(effects)}))
    update = {"gravity_m_per_s2": 1.0, "struts": tuple(struts)}
    plant = DartPlant(spec.model_copy(update=update))
    found: list[tuple[float, float]] = []
    for q, v in ((0.0, 0.0), (0.11, 0.0), (-0.07, 1.3)):
        here = plant.mechanics(np.array([q]), np.array([v]))
        row = float(here.struts[0, 0])
        found.append((float(here.mass[0, 0]) / row**2, float(here.bias[0]) / row))
    if not np.allclose(found, found[0], rtol=_SAME, atol=_SAME):
        raise InputError(
            f"model {spec.name}: springs or dampers of its joints, expected a guide without them "
            "for a bench as an FMU (a strut alone can always be exported)"
        )
    return found[0]


def _own_names(effects: Iterable[EffectSpec]) -> list[str]:
    """A prefix for each effect of a strut: its name, numbered where it stands there again."""
    seen: Counter[str] = Counter()
    names: list[str] = []
    for item in effects:
        seen[item.name] += 1
        number = seen[item.name]
        names.append(f"{item.name}." if number == 1 else f"{item.name}_{number}.")
    return names


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _plain_unit(unit: str) -> str:
    return unit.replace("·", ".").replace("°C", "degC").replace("²", "2").replace("³", "3")
