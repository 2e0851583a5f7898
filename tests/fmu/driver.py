"""FMUs written for this system alone, and FMPy as their master."""

import itertools
import platform
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from numpy.typing import NDArray

from dart_model.spec import ModelSpec, dump_model
from rig.fmu.archive import archive
from rig.fmu.binaries import TARGETS, Target
from rig.fmu.component import Component

Array = NDArray[np.float64]

_NUMBERS = itertools.count()


def this_system() -> Target:
    """The target of this program's own system."""
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    name = {"linux": "linux", "win32": "windows", "darwin": "darwin"}[sys.platform]
    (target,) = [item for item in TARGETS if item.fmi_3 == f"{machine}-{name}"]
    return target


def written(folder: Path, component: Component, version: str, spec: ModelSpec) -> Path:
    """An FMU with a binary for this system."""
    path = folder / f"{component.identifier}_{next(_NUMBERS)}.fmu"
    path.write_bytes(archive(component, version, dump_model(spec), [this_system()]))
    return path


def simulated(
    path: Path, kind: str, starts: Mapping[str, float], name: str, duration_s: float, step_s: float
) -> tuple[Array, int]:
    """A variable at equal steps, and the number of events on the way.

    In Model Exchange FMPy integrates by CVode, to a relative tolerance of 1e-10.
    """
    result = fmpy.simulate_fmu(
        str(path),
        fmi_type=kind,
        start_values=dict(starts),
        stop_time=duration_s,
        output_interval=step_s,
        output=[name],
        relative_tolerance=1e-10,
    )
    t_s = np.arange(round(duration_s / step_s) + 1) * step_s
    # FMPy has a row before and a row after each event.
    return np.interp(t_s, result["time"], result[name]), (len(result) - len(t_s)) // 2


@contextmanager
def loaded(
    path: Path, starts: Mapping[str, float] | None = None
) -> Iterator[tuple[Any, dict[str, int]]]:
    """An initialised instance for Co-Simulation, and its value references by name."""
    description = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path))
    places = {item.name: item.valueReference for item in description.modelVariables}
    instance = (FMU3Slave if description.fmiVersion == "3.0" else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="it",
    )
    instance.instantiate()
    try:
        if not is_3(instance):
            instance.setupExperiment(startTime=0.0)
        put(instance, places, starts or {})
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        yield instance, places
    finally:
        instance.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)


def is_3(instance: Any) -> bool:
    """Whether an instance is of FMI 3.0."""
    return isinstance(instance, FMU3Slave)


def put(instance: Any, places: Mapping[str, int], values: Mapping[str, float]) -> None:
    """Set variables."""
    setter = instance.setFloat64 if is_3(instance) else instance.setReal
    if values:
        setter([places[name] for name in values], list(values.values()))


def got(instance: Any, places: Mapping[str, int], names: Sequence[str]) -> list[float]:
    """Read variables."""
    getter = instance.getFloat64 if is_3(instance) else instance.getReal
    return getter([places[name] for name in names])


def stepped(
    path: Path, t_s: Array, inputs: Mapping[str, Array], names: Sequence[str]
) -> dict[str, Array]:
    """Outputs at given times in Co-Simulation under inputs that are linear in between.

    FMI 3.0 knows no slopes of inputs: it is given the mean over each step.
    """
    starts = {name: float(values[0]) for name, values in inputs.items()}
    rows: list[list[float]] = []
    with loaded(path, starts) as (instance, places):
        rows.append(got(instance, places, names))
        for k in range(len(t_s) - 1):
            h = float(t_s[k + 1] - t_s[k])
            if is_3(instance):
                put(instance, places, {n: float(v[k : k + 2].mean()) for n, v in inputs.items()})
            else:
                put(instance, places, {n: float(v[k]) for n, v in inputs.items()})
                slopes = [float(v[k + 1] - v[k]) / h for v in inputs.values()]
                _slopes(instance, [places[n] for n in inputs], slopes)
            instance.doStep(float(t_s[k]), h)
            if is_3(instance):
                put(instance, places, {n: float(v[k + 1]) for n, v in inputs.items()})
            rows.append(got(instance, places, names))
    return dict(zip(names, np.array(rows).T, strict=True))


def _slopes(instance: Any, references: list[int], slopes: list[float]) -> None:
    count = len(references)
    instance.fmi2SetRealInputDerivatives(
        instance.component,
        (fmpy.fmi2.fmi2ValueReference * count)(*references),
        count,
        (fmpy.fmi2.fmi2Integer * count)(*([1] * count)),
        (fmpy.fmi2.fmi2Real * count)(*slopes),
    )
