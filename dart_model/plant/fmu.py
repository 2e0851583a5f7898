"""A strut whose force a functional mock-up unit (FMU) computes, in Model Exchange.

Its continuous states are internal states of the strut, which the plant integrates like any other;
nothing else of it is set but time and inputs. A bench of one degree of freedom is a strut as well:
its height and velocity are then states, and its force is what accelerates it, less what is applied.

Reference: Functional Mock-up Interface Specification 2.0.4 and 3.0.1, "FMI for Model Exchange".
"""

import contextlib
import ctypes
import importlib.util
import io
import math
import re
import shutil
import tempfile
import weakref
import zipfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from can_dbc.errors import missing_package
from dart_model.errors import ModelError
from dart_model.plant.admitted_programs import require_admission
from dart_model.spec import FmuSpec

_Doubles = ctypes.Array[ctypes.c_double]

_MOST_ITERATIONS = 20
"""Most event iterations at one time."""
_INTERFACES = ("modelExchange", "coSimulation", "scheduledExecution")
_C_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_MESSAGES = 3
"""Most recent messages of an FMU that an error contains."""


class MockUp:
    """One instance of an FMU, as the part of a strut's force that it computes.

    Its result depends on its arguments alone as long as the FMU has no state but its continuous
    states; one that declares others is refused.

    Attributes:
        state_scales: Usual size of each internal state: a continuous state less its start.

    Raises:
        ModelError: This user never imported the file, or it does not offer what the strut needs.
    """

    def __init__(self, spec: FmuSpec, folder: Path, gravity_m_per_s2: float) -> None:
        path = folder / spec.file
        content = read_program(path)
        require_admission(content, path)
        self._unit = _Unit(content, path, spec)
        self.name = f"FMU {spec.file}"
        self.state_scales = self._unit.nominals
        self._mass_kg, self._gravity = spec.mass_kg, gravity_m_per_s2
        self._is_bench = spec.acceleration is not None
        self._arguments: tuple[object, ...] = ()
        self._result: tuple[float, list[float]] = (math.nan, [])

    def force(self, *arguments: Any) -> float:
        """Force in N; arguments as of `dart_model.effects.calling.ForceOverArrays`."""
        return self._evaluate(*arguments[:6])[0]

    def rate(self, *arguments: Any) -> None:
        """Derivative of the internal states; arguments as of `RatesOverArrays`."""
        arguments[8][:] = self._evaluate(*arguments[:6])[1]

    def _evaluate(
        self,
        t_s: float,
        height_m: float,
        velocity_m_per_s: float,
        applied_force_n: float,
        temperature_c: float,
        state: Sequence[float],
    ) -> tuple[float, list[float]]:
        arguments = (t_s, height_m, velocity_m_per_s, applied_force_n, temperature_c, tuple(state))
        if arguments != self._arguments:
            force, rates = self._unit.at(*arguments)
            if self._is_bench:
                force = self._mass_kg * (force + self._gravity) - applied_force_n
            self._arguments, self._result = arguments, (force, rates)
        return self._result


class _Unit:
    """An FMU with its variables by their meaning for a strut."""

    def __init__(self, content: bytes, path: Path, spec: FmuSpec) -> None:
        description = read_description(content, path)
        variables = {item.name: item for item in description.modelVariables}
        states = [item.variable.derivative.name for item in description.derivatives]
        _refuse_unfit(path, description, spec, variables)
        roles = (spec.height, spec.velocity, spec.temperature, spec.applied_force)
        self._inputs: list[_Variable] = []
        moving: list[_Variable] = []
        for role, name in enumerate(roles):
            if name is None:
                continue
            sign, plain = _split_sign(name)
            if plain in states:
                moving.append(_Variable(states.index(plain), sign, role))
            elif variables[plain].causality == "input":
                self._inputs.append(_Variable(variables[plain].valueReference, sign, role))
            else:
                raise ModelError(f"{path}: {plain}: expected an input or a state of the FMU")
        self._moving = moving
        self._sign, plain = _split_sign(spec.force or spec.acceleration or "")
        self._output = [variables[plain].valueReference]
        taken = {item.number for item in moving}
        self.internal = [k for k in range(len(states)) if k not in taken]
        self._count = len(states)
        self._x, self._dx = _doubles(self._count), _doubles(self._count)
        self._has_events = bool(description.numberOfEventIndicators)
        parameters = {variables[n].valueReference: v for n, v in spec.parameters.items()}
        self._calls = _start(content, path, description, parameters)
        self._start, nominals = self._calls.states_and_nominals(self._count)
        self.nominals = tuple(nominals[k] for k in self.internal)

    def at(
        self,
        t_s: float,
        height_m: float,
        velocity_m_per_s: float,
        applied_force_n: float,
        temperature_c: float,
        state: Sequence[float],
    ) -> tuple[float, list[float]]:
        """Output and derivatives; NaN where the FMU refuses, so that the model diverges by name."""
        given = (height_m, velocity_m_per_s, temperature_c, applied_force_n)
        x, calls = self._x, self._calls
        for k, value in zip(self.internal, state, strict=True):
            x[k] = self._start[k] + value
        for index, sign, role in self._moving:
            x[index] = sign * given[role]
        inputs = [sign * given[role] for _, sign, role in self._inputs]
        try:
            calls.move(t_s, x, self._count, [index for index, _, _ in self._inputs], inputs)
            if self._has_events:
                calls.settle()
            if self._count:
                calls.derivatives(self._dx, self._count)
            (value,) = calls.read(self._output)
        except (_Refused, *_errors()):
            # Its state between two calls is unknown: restarted, so that the next result does not
            # depend on it.
            calls.begin_again()
            return math.nan, [math.nan] * len(self.internal)
        return self._sign * value, [self._dx[k] for k in self.internal]


class _Variable(NamedTuple):
    """A variable that is set.

    Attributes:
        number: Value reference, or index of a state.
        sign: Sign of the FMU's value where ours is positive.
        role: Index in what is given: height, velocity, temperature, applied force.
    """

    number: int
    sign: float
    role: int


class _Refused(Exception):  # noqa: N818  # an FMU's refusal, caught in this module
    """An FMU ends the simulation, changes its states by itself, or comes to no end of events."""


class _Calls:
    """The calls of Model Exchange, which differ by the version of the interface in their names."""

    def __init__(self, instance: Any, parameters: Mapping[int, float], *, is_3: bool) -> None:
        self._it, self._is_3, self._parameters = instance, is_3, parameters
        self._update = instance.updateDiscreteStates if is_3 else instance.newDiscreteStates
        self.read = instance.getFloat64 if is_3 else instance.getReal
        self.write = instance.setFloat64 if is_3 else instance.setReal
        self.derivatives = (
            instance.getContinuousStateDerivatives if is_3 else instance.getDerivatives
        )

    def begin(self) -> None:
        """From an instance to continuous time."""
        if not self._is_3:
            self._it.setupExperiment(startTime=0.0)
        if self._parameters:
            self.write(list(self._parameters), list(self._parameters.values()))
        self._it.enterInitializationMode()
        self._it.exitInitializationMode()
        self.iterate()
        self._it.enterContinuousTimeMode()

    def begin_again(self) -> None:
        """The same after a refusal; what does not come back refuses everything from then on."""
        with contextlib.suppress(_Refused, *_errors()):
            self._it.reset()
            self.begin()

    def move(
        self, t_s: float, x: _Doubles, count: int, references: list[int], inputs: list[float]
    ) -> None:
        """Set time, states and inputs."""
        self._it.setTime(t_s)
        if count:
            self._it.setContinuousStates(x, count)
        if references:
            self.write(references, inputs)

    def settle(self) -> None:
        """Let switches change at the present state."""
        self._it.enterEventMode()
        if self.iterate():
            raise _Refused("changes its states by itself")
        self._it.enterContinuousTimeMode()

    def iterate(self) -> bool:
        """Handle events until there are none; whether states changed."""
        changed = False
        for _ in range(_MOST_ITERATIONS):
            again, ends, _, moved, has_own_times, _ = self._update()
            changed |= bool(moved)
            if ends or has_own_times:
                raise _Refused("ends by itself, or has events at times that it sets")
            if not again:
                return changed
        raise _Refused("comes to no end of events")

    def states_and_nominals(self, count: int) -> tuple[list[float], list[float]]:
        """The continuous states, and their usual size."""
        states, nominals = _doubles(count), _doubles(count)
        if count:
            self._it.getContinuousStates(states, count)
            self._it.getNominalsOfContinuousStates(nominals, count)
        return list(states[:count]), list(nominals[:count])


def _doubles(count: int) -> _Doubles:
    return (ctypes.c_double * max(count, 1))()


def _split_sign(name: str) -> tuple[float, str]:
    return (-1.0, name[1:]) if name.startswith("-") else (1.0, name)


def _errors() -> tuple[type[Exception], ...]:
    from fmpy.fmi1 import FMICallException

    return (FMICallException,)


def read_program(path: Path) -> bytes:
    """An FMU's bytes, read once: what is checked is what runs.

    Raises:
        ModelError: It cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror})") from error


def read_description(content: bytes, path: Path) -> Any:
    """Description of an FMU, as FMPy reads it; nothing of it is executed.

    Raises:
        ModelError: It is no FMU, names files outside its own folder, or FMPy is not installed.
    """
    if importlib.util.find_spec("fmpy") is None:
        raise ModelError(missing_package("fmpy", "pip install -e '.[fmu]'"))
    import fmpy

    try:
        description = cast("Any", fmpy).read_model_description(io.BytesIO(content))
    except Exception as error:  # of any library that a hostile archive may upset
        raise ModelError(
            f"{path}: is no FMU of FMI 2.0 or 3.0, expected an archive with a valid "
            "modelDescription.xml: export it again"
        ) from error
    _refuse_outside(content, path, description)
    if any(item.variable.derivative is None for item in description.derivatives):
        raise ModelError(f"{path}: a derivative without a state, expected the state that it is of")
    return description


def _refuse_outside(content: bytes, path: Path, description: Any) -> None:
    """Refuse an FMU that names files outside its own folder.

    A library would be loaded from there, while what was admitted is the content of the archive.
    """
    offered = [getattr(description, interface) for interface in _INTERFACES]
    for identifier in [item.modelIdentifier or "" for item in offered if item is not None]:
        if not _C_IDENTIFIER.fullmatch(identifier):
            raise ModelError(
                f"{path}: modelDescription.xml: modelIdentifier {identifier!r:.200}: expected a C "
                "identifier, as FMI does: letters, digits and _"
            )
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for name in archive.namelist():
            if name.startswith("/") or "\\" in name or ":" in name or ".." in name.split("/"):
                raise ModelError(
                    f"{path}: {name!r:.200}: expected files in the folder of the FMU alone"
                )


def _refuse_unfit(
    path: Path, description: Any, spec: FmuSpec, variables: Mapping[str, Any]
) -> None:
    """Refuse an FMU that cannot be part of a strut."""
    exchange = description.modelExchange
    if description.fmiVersion not in ("2.0", "3.0"):
        raise ModelError(f"{path}: FMI {description.fmiVersion}: expected 2.0 or 3.0")
    if exchange is None:
        raise ModelError(
            f"{path}: offers Co-Simulation alone, whose states cannot be put back between the "
            "stages of a step: expected an FMU with Model Exchange"
        )
    if exchange.canBeInstantiatedOnlyOncePerProcess or exchange.needsExecutionTool:
        raise ModelError(
            f"{path}: can be instantiated only once, or needs the tool that made it: expected an "
            "FMU that stands alone"
        )
    remembers = [
        item.name
        for item in description.modelVariables
        if item.variability == "discrete" and item.causality in ("local", "output")
    ]
    if remembers:
        raise ModelError(
            f"{path}: {remembers[0]}: a discrete variable, which a replay could not put back: "
            "expected an FMU that remembers continuous states alone"
        )
    roles = {
        "height": spec.height,
        "velocity": spec.velocity,
        "temperature": spec.temperature,
        "applied_force": spec.applied_force,
        "force": spec.force,
        "acceleration": spec.acceleration,
        **{f"parameters {name}": name for name in spec.parameters},
    }
    for key, name in roles.items():
        if name is None:
            continue
        plain = name if key.startswith("parameters ") else _split_sign(name)[1]
        if plain not in variables:
            there = [n for n, v in variables.items() if v.causality in ("input", "output")]
            raise ModelError(
                f"{path}: {key}: no variable {plain!r}, expected one such as "
                f"{', '.join(there)[:300]}"
            )
        if variables[plain].type not in ("Real", "Float64") or variables[plain].dimensions:
            raise ModelError(f"{path}: {key}: {plain}: expected a single real number")
        if key.startswith("parameters ") and variables[plain].causality != "parameter":
            raise ModelError(f"{path}: {key}: expected a parameter of the FMU")


def _start(content: bytes, path: Path, description: Any, parameters: Mapping[int, float]) -> _Calls:
    """An instance in continuous time, at its start."""
    import fmpy
    from fmpy.fmi2 import FMU2Model
    from fmpy.fmi3 import FMU3Model

    is_3 = description.fmiVersion == "3.0"
    messages: deque[str] = deque(maxlen=_MESSAGES)
    folder = tempfile.mkdtemp(prefix="rig-fmu-")
    try:
        cast("Any", fmpy).extract(io.BytesIO(content), folder)
        instance: Any = (FMU3Model if is_3 else FMU2Model)(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.modelExchange.modelIdentifier,
            instanceName="strut",
        )
        if is_3:
            instance.instantiate(logMessage=_keep_in(messages))
        else:
            instance.instantiate(callbacks=_callbacks(messages), loggingOn=False)
        calls = _Calls(instance, parameters, is_3=is_3)
        weakref.finalize(calls, _free, instance, folder)
        calls.begin()
    except Exception as error:  # FMPy raises its base class
        shutil.rmtree(folder, ignore_errors=True)
        raise ModelError(
            f"{path}: does not start ({'; '.join([str(error), *messages])})"
        ) from error
    return calls


def _callbacks(messages: deque[str]) -> Any:
    """Functions that an FMU of FMI 2.0 may call; its messages are kept, and nothing is printed."""
    from fmpy import fmi2

    callbacks: Any = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(_keep_in(messages))
    callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
    return callbacks


def _keep_in(messages: deque[str]) -> Callable[..., None]:
    def keep(*arguments: object) -> None:
        messages.append(cast("bytes", arguments[-1] or b"").decode("utf-8", "replace").strip())

    return keep


def _free(instance: Any, folder: str) -> None:
    instance.freeInstance()
    shutil.rmtree(folder, ignore_errors=True)
