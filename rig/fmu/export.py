"""A model file written as an FMU."""

from collections.abc import Callable
from pathlib import Path

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, StrutSpec, dump_model
from rig.fmu.archive import archive
from rig.fmu.component import Component, bench_component, strut_component
from rig.fmu.source import VERSIONS


def export_fmu(
    spec: ModelSpec,
    out: Path,
    fmi: str,
    strut: str | None,
    bench: bool,
    compiled: Callable[[str], None] = lambda _: None,
) -> Component:
    """Write a strut, or the whole bench, as an FMU.

    Args:
        spec: The model.
        out: New file.
        fmi: Version of the interface, ``2.0`` or ``3.0``.
        strut: Name of the strut; None for the only one.
        bench: Whether the whole bench is meant.
        compiled: Called with the name of every system that it is compiled for.

    Returns:
        What was written.

    Raises:
        InputError: The file is there or cannot be written, there is no such version or strut, the
            bench cannot be said in an FMU, or there is no compiler.
    """
    if fmi not in VERSIONS:
        raise InputError(f"--fmi {fmi!r}: expected {' or '.join(VERSIONS)}")
    if out.exists():
        raise InputError(f"{out}: exists, expected a new file")
    meant = spec.struts if bench else [_chosen(spec, strut)]
    for item in meant:
        if item.fmu is not None:
            raise InputError(
                f"model {spec.name}: strut {item.name} has an FMU, expected one without: its force "
                "cannot be put into another"
            )
    component = bench_component(spec) if bench else strut_component(spec, _chosen(spec, strut))
    content = archive(component, fmi, dump_model(spec), done=lambda target: compiled(target.words))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(content)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return component


def _chosen(spec: ModelSpec, name: str | None) -> StrutSpec:
    if name is not None:
        return spec.strut(name)
    first, *others = spec.struts
    if others:
        choices = ", ".join(item.name for item in spec.struts)
        raise InputError(f"model {spec.name}: --strut: expected one of {choices}, or --bench")
    return first
