"""An FMU's description of itself, as XML after FMI 2.0 and 3.0."""

import re
from collections.abc import Mapping
from typing import NamedTuple
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
"""Units as products of base units; another unit is named without them."""


class Made(NamedTuple):
    """By what an FMU is made.

    Attributes:
        tool: Program and version.
        token: What tells this FMU from any other.
        experiment_s: Length of a usual simulation.
        step_s: Its step.
    """

    tool: str
    token: str
    experiment_s: float
    step_s: float


def description_2(component: Component, made: Made, files: list[str]) -> str:
    """``modelDescription.xml`` of FMI 2.0.

    Args:
        component: What the FMU computes.
        made: By what it is made.
        files: C files that a compiler is given.
    """
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=component.name,
        guid=made.token,
        description=component.meaning,
        generationTool=made.tool,
        variableNamingConvention="structured",
        numberOfEventIndicators=str(len(component.of("indicator"))),
    )
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
        listed = SubElement(parent, "SourceFiles")
        for name in files:
            SubElement(listed, "File", name=name)
    _about_all(root, component, made)
    known = [item for item in component.variables if item.kind != "indicator"]
    variables = SubElement(root, "ModelVariables")
    rates = {place: state for (place, _), (state, _) in _rates(component)}
    for place, item in enumerate(known):
        scalar = SubElement(variables, "ScalarVariable", _attributes(item, place))
        real = SubElement(scalar, "Real", _unit(item))
        if item.start is not None:
            real.set("start", repr(float(item.start)))
        if item.kind == "state":
            real.set("nominal", repr(float(item.nominal)))
        if place in rates:
            real.set("derivative", str(rates[place] + 1))
    structure = SubElement(root, "ModelStructure")
    outputs = [place for place, item in enumerate(known) if _is_output(item)]
    calculated = [place for place, item in enumerate(known) if item.kind in ("rate", "output")]
    for tag, places in (
        ("Outputs", outputs),
        ("Derivatives", list(rates)),
        ("InitialUnknowns", calculated),
    ):
        if places:
            listed = SubElement(structure, tag)
            for place in places:
                SubElement(listed, "Unknown", index=str(place + 1))
    return _text(root)


def description_3(component: Component, made: Made) -> str:
    """``modelDescription.xml`` of FMI 3.0; arguments as of `description_2`."""
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=component.name,
        instantiationToken=made.token,
        description=component.meaning,
        generationTool=made.tool,
        variableNamingConvention="structured",
    )
    able = {
        "modelIdentifier": component.identifier,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
    }
    SubElement(root, "ModelExchange", able)
    SubElement(root, "CoSimulation", able | {"canHandleVariableCommunicationStepSize": "true"})
    _about_all(root, component, made)
    variables = SubElement(root, "ModelVariables")
    rates = {place: state for (place, _), (state, _) in _rates(component)}
    for place, item in enumerate(component.variables):
        made_of = _attributes(item, place) | _unit(item)
        if item.start is not None:
            made_of["start"] = repr(float(item.start))
        if item.kind == "state":
            made_of["nominal"] = repr(float(item.nominal))
        if place in rates:
            made_of["derivative"] = str(rates[place])
        SubElement(variables, "Float64", made_of)
    structure = SubElement(root, "ModelStructure")
    outputs = [place for place, item in enumerate(component.variables) if _is_output(item)]
    calculated = [place for place, _ in (*component.of("rate"), *component.of("output"))]
    indicators = [place for place, _ in component.of("indicator")]
    for tag, places in (
        ("Output", outputs),
        ("ContinuousStateDerivative", list(rates)),
        ("InitialUnknown", calculated),
        ("EventIndicator", indicators),
    ):
        for place in places:
            SubElement(structure, tag, valueReference=str(place))
    return _text(root)


def build_description(component: Component, files: list[str]) -> str:
    """``buildDescription.xml`` of FMI 3.0; arguments as of `description_2`."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(
        root, "BuildConfiguration", modelIdentifier=component.identifier, description="C99"
    )
    listed = SubElement(configuration, "SourceFileSet", language="C99")
    for name in files:
        SubElement(listed, "SourceFile", name=name)
    return _text(root)


def _about_all(root: Element, component: Component, made: Made) -> None:
    """Units, log categories and a usual experiment."""
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
        stopTime=repr(made.experiment_s),
        stepSize=repr(made.step_s),
    )


def _base_units(name: str) -> dict[str, str] | None:
    """A unit such as ``N.s/m`` in base units; None if it cannot be said in them."""
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
    made = {
        "name": item.name,
        "valueReference": str(reference),
        "description": item.meaning,
        "causality": "output" if item.is_output else causality,
        "variability": variability,
    }
    return made if initial is None else made | {"initial": initial}


def _unit(item: Variable) -> dict[str, str]:
    return {"unit": item.unit} if item.unit else {}


def _is_output(item: Variable) -> bool:
    return item.kind == "output" or item.is_output


def _rates(
    component: Component,
) -> list[tuple[tuple[int, Variable], tuple[int, Variable]]]:
    """Every rate with the state that it is of."""
    return list(zip(component.of("rate"), component.of("state"), strict=True))


def _text(root: Element) -> str:
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
