"""An FMU's description of itself, as XML after FMI 2.0 and 3.0."""

import re
from collections.abc import Mapping
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from rig.fmu.component import Component, Variable

_CAUSALITY = {
    "time": ("independent", "continuous", None),
    "input": ("input", "continuous", None),
    "parameter": ("parameter", "tunable", "exact"),
    "fixed": ("parameter", "fixed", "exact"),
    "state": ("local", "continuous", "exact"),
    "rate": ("local", "continuous", "calculated"),
    "output": ("output", "continuous", "calculated"),
    "indicator": ("local", "continuous", "calculated"),
}
"""Kind of a variable -> its causality, variability and way of being initialised."""

_BASE: Mapping[str, Mapping[str, int]] = {
    "m": {"m": 1},
    "s": {"s": 1},
    "m2": {"m": 2},
    "m3": {"m": 3},
    "s2": {"s": 2},
    "kg": {"kg": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "Hz": {"s": -1},
    "K": {"K": 1},
    "rad": {"rad": 1},
    "1": {},
}
"""Units as products of base units; any other unit has a name alone."""

_EXPERIMENT_S, _STEP_S = 10.0, 0.001
"""Length of a usual simulation, and its step."""


def description_2(component: Component, tool: str, token: str, files: list[str]) -> str:
    """``modelDescription.xml`` of FMI 2.0.

    `tool` writes it, `token` identifies the content, and a compiler is given the C files `files`.
    """
    root = _root(component, tool, "2.0", {"guid": token})
    root.set("numberOfEventIndicators", str(len(component.of("indicator"))))
    states = {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
    exchange = SubElement(root, "ModelExchange", {"modelIdentifier": component.identifier} | states)
    simulation = SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": component.identifier,
            "canHandleVariableCommunicationStepSize": "true",
            "canInterpolateInputs": "true",
            "maxOutputDerivativeOrder": "0",
        }
        | states,
    )
    for parent in (exchange, simulation):
        source_files = SubElement(parent, "SourceFiles")
        for name in files:
            SubElement(source_files, "File", name=name)
    _add_definitions(root, component)
    listed = [item for item in component.variables if item.kind != "indicator"]
    variables = SubElement(root, "ModelVariables")
    states = _state_of_rate(component)
    for index, item in enumerate(listed):
        scalar = SubElement(variables, "ScalarVariable", _attributes(item, index))
        derivative = states[index] + 1 if index in states else None
        SubElement(scalar, "Real", _number_attributes(item, derivative))
    structure = SubElement(root, "ModelStructure")
    for tag, indices in (
        ("Outputs", _outputs(component)),
        ("Derivatives", list(states)),
        ("InitialUnknowns", _rates_and_outputs(component)),
    ):
        if indices:
            unknowns = SubElement(structure, tag)
            for index in indices:
                SubElement(unknowns, "Unknown", index=str(index + 1))
    return _text(root)


def description_3(component: Component, tool: str, token: str) -> str:
    """``modelDescription.xml`` of FMI 3.0; arguments as of `description_2`."""
    root = _root(component, tool, "3.0", {"instantiationToken": token})
    able = {
        "modelIdentifier": component.identifier,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
    }
    SubElement(root, "ModelExchange", able)
    SubElement(root, "CoSimulation", able | {"canHandleVariableCommunicationStepSize": "true"})
    _add_definitions(root, component)
    variables = SubElement(root, "ModelVariables")
    states = _state_of_rate(component)
    for index, item in enumerate(component.variables):
        number = _number_attributes(item, states.get(index))
        SubElement(variables, "Float64", _attributes(item, index) | number)
    structure = SubElement(root, "ModelStructure")
    for tag, indices in (
        ("Output", _outputs(component)),
        ("ContinuousStateDerivative", list(states)),
        ("InitialUnknown", _rates_and_outputs(component)),
        ("EventIndicator", [index for index, _ in component.of("indicator")]),
    ):
        for index in indices:
            SubElement(structure, tag, valueReference=str(index))
    return _text(root)


def build_description(component: Component, files: list[str]) -> str:
    """``buildDescription.xml`` of FMI 3.0; arguments as of `description_2`."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(
        root, "BuildConfiguration", modelIdentifier=component.identifier, description="C99"
    )
    source_files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in files:
        SubElement(source_files, "SourceFile", name=name)
    return _text(root)


def _root(component: Component, tool: str, version: str, token: dict[str, str]) -> Element:
    return Element(
        "fmiModelDescription",
        {"fmiVersion": version, "modelName": component.name},
        **token,
        description=component.meaning,
        generationTool=tool,
        variableNamingConvention="structured",
    )


def _add_definitions(root: Element, component: Component) -> None:
    """Add units, log categories and the default experiment."""
    units = SubElement(root, "UnitDefinitions")
    for name in sorted({item.unit for item in component.variables if item.unit}):
        unit = SubElement(units, "Unit", name=name)
        base = _base_units(name)
        if base is not None:
            SubElement(unit, "BaseUnit", base)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError", description="what went wrong")
    SubElement(
        root,
        "DefaultExperiment",
        startTime="0",
        stopTime=repr(_EXPERIMENT_S),
        stepSize=repr(_STEP_S),
    )


def _base_units(name: str) -> dict[str, str] | None:
    """A unit such as ``N.s/m`` in base units; None if they do not express it."""
    if name == "degC":
        return {"K": "1", "offset": "273.15"}
    exponents: dict[str, int] = {}
    for sign, factor in re.findall(r"(^|[./])([^./]+(?:\.\d+)?)", name):
        match = re.fullmatch(r"([A-Za-z]+|1)(\d?)", factor)
        if match is None or match[1] not in _BASE:
            return None
        power = int(match[2] or 1) * (-1 if sign == "/" else 1)
        for base, exponent in _BASE[match[1]].items():
            exponents[base] = exponents.get(base, 0) + power * exponent
    return {base: str(exponent) for base, exponent in exponents.items() if exponent}


def _attributes(item: Variable, reference: int) -> dict[str, str]:
    causality, variability, initial = _CAUSALITY[item.kind]
    attributes = {
        "name": item.name,
        "valueReference": str(reference),
        "description": item.meaning,
        "causality": "output" if item.is_output else causality,
        "variability": variability,
    }
    return attributes if initial is None else attributes | {"initial": initial}


def _number_attributes(item: Variable, derivative: int | None) -> dict[str, str]:
    """Unit, start, nominal size, and the state whose derivative it is."""
    attributes = {"unit": item.unit} if item.unit else {}
    if item.start is not None:
        attributes["start"] = repr(float(item.start))
    if item.kind == "state":
        attributes["nominal"] = repr(float(item.nominal))
    if derivative is not None:
        attributes["derivative"] = str(derivative)
    return attributes


def _outputs(component: Component) -> list[int]:
    """Indices of the outputs; indicators, the last variables, are none."""
    variables = enumerate(component.variables)
    return [index for index, item in variables if item.kind == "output" or item.is_output]


def _rates_and_outputs(component: Component) -> list[int]:
    """Indices of the rates and the outputs."""
    return [index for index, _ in (*component.of("rate"), *component.of("output"))]


def _state_of_rate(component: Component) -> dict[int, int]:
    """Index of the state by the index of its rate."""
    pairs = zip(component.of("rate"), component.of("state"), strict=True)
    return {rate: state for (rate, _), (state, _) in pairs}


def _text(root: Element) -> str:
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
