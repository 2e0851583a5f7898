"""A model file written as an FMU."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from can_dbc.atomic_file import write_whole
from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, StrutSpec, dump_model
from dart_model.virtual_sensors import VirtualSensor
from rig.fmu.archive import archive
from rig.fmu.component import Component, bench_component, strut_component
from rig.fmu.source import VERSIONS


def export_fmu(
    spec: ModelSpec,
    out: Path,
    fmi: str,
    strut: str | None,
    bench: bool,
    report_compiled: Callable[[str], None] = lambda _: None,
    sensors: Mapping[str, VirtualSensor] = MappingProxyType({}),
) -> Component:
    """Write a strut, or the whole bench, as an FMU of version ``2.0`` or ``3.0``.

    The strut may be None where the model has only one. `report_compiled` is called with the name of
    each system, once its binary is compiled. Virtual sensors are outputs of a bench. What was
    written is returned.

    Raises:
        InputError: The file is there or cannot be written, there is no such version or strut, the
            bench cannot be expressed as an FMU, or there is no compiler.
    """
    if fmi not in VERSIONS:
        raise InputError(f"--fmi {fmi!r}: expected {' or '.join(VERSIONS)}")
    if out.exists():
        raise InputError(f"{out}: exists, expected a new file")
    struts = spec.struts if bench else [_choose_strut(spec, strut)]
    for item in struts:
        if item.fmu is not None:
            raise InputError(
                f"model {spec.name}: strut {item.name} has an FMU, expected one without: its force "
                "cannot be part of another"
            )
    component = bench_component(spec, sensors) if bench else strut_component(spec, struts[0])
    content = archive(
        component, fmi, dump_model(spec), done=lambda target: report_compiled(target.words)
    )
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, content)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return component


def _choose_strut(spec: ModelSpec, name: str | None) -> StrutSpec:
    if name is not None:
        return spec.strut(name)
    first, *others = spec.struts
    if others:
        choices = ", ".join(item.name for item in spec.struts)
        raise InputError(f"model {spec.name}: --strut: expected one of {choices}, or --bench")
    return first
