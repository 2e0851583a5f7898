"""The C sources of an FMU: those that all FMUs share, and the model's two."""

from collections.abc import Iterable, Mapping
from importlib.resources import files
from string import Template

from rig.fmu.component import KINDS, LONGEST_STEP, Component, Kind

VERSIONS: Mapping[str, tuple[str, ...]] = {
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


def sources(component: Component, version: str, token: str) -> dict[str, str]:
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


def _header(component: Component, token: str, version: str) -> str:
    """The file `model.h`, from its template."""
    kinds = [item.kind for item in component.variables]
    first = 0
    lines: list[str] = []
    for kind in KINDS:
        if kind != "time":
            lines.append(f"#define FIRST_{kind.upper()} {first}")
        if kind in _COUNTS:
            lines.append(f"#define {_COUNTS[kind]} {kinds.count(kind)}")
        first += kinds.count(kind)
    return Template(read_common_source("model.h.template")).substitute(
        fmi=f"FMI{version[0]}",
        identifier=component.identifier,
        token=token,
        counts="\n".join(lines),
        values=first,
        longest_step=[item.name for item in component.variables].index(LONGEST_STEP),
    )


def _model(component: Component) -> str:
    """The file `model.c`, from its template."""
    nominals = [repr(item.nominal) for _, item in component.of("state")]
    return Template(read_common_source("model.c.template")).substitute(
        starts=", ".join(repr(item.start or 0.0) for item in component.variables),
        nominals=", ".join(nominals) or "0.0",
        laws=component.laws,
        evaluation="\n".join(f"    {line}" for line in component.evaluation.splitlines()),
    )
