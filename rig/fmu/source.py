"""The C sources of an FMU: those that all FMUs share, and the model's two."""

from collections.abc import Iterable, Mapping
from importlib.resources import files

from rig.fmu.component import KINDS, LONGEST_STEP, Component, Kind

Fmi = str
"""Version of the interface: ``2.0`` or ``3.0``."""

VERSIONS: Mapping[Fmi, tuple[str, ...]] = {
    "2.0": ("fmi2.c", "fmi2.h"),
    "3.0": ("fmi3.c", "fmi3.h"),
}
"""Files of each version of the interface."""

_COMMON = ("component.c", "component.h", "switches.h")
_COUNTS: Mapping[Kind, str] = {
    "input": "INPUTS",
    "parameter": "PARAMETERS",
    "fixed": "FIXED",
    "state": "STATES",
    "output": "OUTPUTS",
    "indicator": "SWITCHES",
}


def sources(component: Component, version: Fmi, token: str) -> dict[str, str]:
    """Every C file of an FMU by its name.

    The token is that of the description, so that no other binary is taken for it.
    """
    code = {name: read_common_source(name) for name in (*_COMMON, *VERSIONS[version])}
    code["model.h"] = _header(component, token, version)
    code["model.c"] = _model(component)
    return code


def read_common_source(name: str) -> str:
    """A C file that all FMUs share."""
    return (files("rig.fmu") / "c" / name).read_text(encoding="utf-8")


def select_c_files(names: Iterable[str]) -> list[str]:
    """The names of the files that are compiled, sorted."""
    return sorted(name for name in names if name.endswith(".c"))


def _header(component: Component, token: str, version: Fmi) -> str:
    kinds = [item.kind for item in component.variables]
    fmi = f"FMI{version[0]}"
    first = 0
    lines: list[str] = []
    for kind in KINDS:
        if kind != "time":
            lines.append(f"#define FIRST_{kind.upper()} {first}")
        if kind in _COUNTS:
            lines.append(f"#define {_COUNTS[kind]} {kinds.count(kind)}")
        first += kinds.count(kind)
    longest = [item.name for item in component.variables].index(LONGEST_STEP)
    return "\n".join(
        [
            "/* The values of this model: time, inputs, parameters that may be tuned, fixed ones,",
            "   states, their rates, outputs and indicators of switches, one after another. */",
            "#ifndef MODEL_H",
            "#define MODEL_H",
            "",
            "/* Linked from their sources, FMUs differ in the names of their functions; a",
            "   shared library has those of the standard. */",
            f"#ifndef {fmi}_OVERRIDE_FUNCTION_PREFIX",
            f"#define {fmi}_FUNCTION_PREFIX {component.identifier}_",
            "#endif",
            "",
            f'#define MODEL_TOKEN "{token}"',
            *lines,
            f"#define VALUES {first}",
            f"#define LONGEST_STEP {longest}",
            "",
            "extern const double model_start[VALUES];",
            "extern const double model_nominals[STATES + 1];",
            "",
            "/* Compute rates, outputs and indicators from the other values. */",
            "void model_evaluate(double *value, long *answer, int is_held);",
            "",
            "#endif",
            "",
        ]
    )


def _model(component: Component) -> str:
    starts = ", ".join(repr(item.start or 0.0) for item in component.variables)
    nominals = ", ".join(repr(item.nominal) for _, item in component.of("state"))
    body = "\n".join(f"    {line}" for line in component.evaluation.splitlines())
    return "\n".join(
        [
            '#include "model.h"',
            "",
            '#include "switches.h"',
            "",
            f"const double model_start[VALUES] = {{{starts}}};",
            "",
            f"const double model_nominals[STATES + 1] = {{{nominals or '0.0'}}};",
            "",
            component.laws,
            "void model_evaluate(double *value, long *answer, int is_held) {",
            "    int k;",
            "    /* Of a switch that is not asked. */",
            "    for (k = 0; k < SWITCHES; ++k)",
            "        value[FIRST_INDICATOR + k] = answer[k] ? 1.0 : -1.0;",
            body,
            "}",
            "",
        ]
    )
