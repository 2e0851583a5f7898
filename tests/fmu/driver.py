"""FMUs under FMPy: loaded, and stepped as a master steps them."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from numpy.typing import NDArray

Array = NDArray[np.float64]


@contextmanager
def loaded(
    path: Path, starts: Mapping[str, float] | None = None
) -> Iterator[tuple[Any, dict[str, int]]]:
    """An initialised instance for Co-Simulation, and its value references by name."""
    description = fmpy.read_model_description(str(path))
    folder = fmpy.extract(str(path))
    places = {item.name: item.valueReference for item in description.modelVariables}
    is_3 = description.fmiVersion == "3.0"
    instance = (FMU3Slave if is_3 else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="it",
    )
    instance.instantiate()
    try:
        if not is_3:
            instance.setupExperiment(startTime=0.0)
        put(instance, places, starts or {})
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        yield instance, places
        instance.terminate()
        instance.freeInstance()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def is_3(instance: Any) -> bool:
    return isinstance(instance, FMU3Slave)


def put(instance: Any, places: Mapping[str, int], values: Mapping[str, float]) -> None:
    setter = instance.setFloat64 if is_3(instance) else instance.setReal
    if values:
        setter([places[name] for name in values], list(values.values()))


def got(instance: Any, places: Mapping[str, int], names: Sequence[str]) -> list[float]:
    getter = instance.getFloat64 if is_3(instance) else instance.getReal
    return getter([places[name] for name in names])


def stepped(
    path: Path, t_s: Array, inputs: Mapping[str, Array], names: Sequence[str]
) -> dict[str, Array]:
    """Outputs at given times under inputs that are linear in between.

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


def exchanged(
    path: Path, t_s: Array, inputs: Mapping[str, Array], names: Sequence[str], tolerance: float
) -> tuple[dict[str, Array], int]:
    """Outputs at given times in Model Exchange, integrated by CVode; and the number of events."""
    signals = np.zeros(len(t_s), dtype=[("time", float), *((name, float) for name in inputs)])
    signals["time"] = t_s
    for name, values in inputs.items():
        signals[name] = values
    result = fmpy.simulate_fmu(
        str(path),
        validate=True,
        fmi_type="ModelExchange",
        start_time=float(t_s[0]),
        stop_time=float(t_s[-1]),
        output_interval=float(t_s[1] - t_s[0]),
        input=signals,
        output=list(names),
        relative_tolerance=tolerance,
    )
    events = len(result) - len(t_s)
    return {name: np.interp(t_s, result["time"], result[name]) for name in names}, events
