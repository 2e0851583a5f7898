"""Configuration of the bridge: YAML -> frozen values, validated once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema
from pydantic_core.core_schema import tagged_union_schema

from can_dbc.errors import expected_name
from can_dbc.units import Dimension
from can_dbc.yaml_file import Finite, Positive
from dart_model.spec import InputName
from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.devices import DeviceSettings
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.published_quantities import STATUS, STRUT, TIMING, Publication
from rig.bus.bus import BusConfig
from rig.bus.secoc import AuthenticationSettings
from rig.channels.channel import MeasuredSignal, SignalName
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    BENCH_QUANTITIES,
    HEIGHT,
    LOAD_CELL_FORCE,
    STRUT_QUANTITIES,
    Quantity,
    SensorNoise,
)
from rig.log.captures import CaptureWindow
from rig.log.rotation import Rotation
from rig.machine.realtime import Realtime
from rig.observers import DEFAULT_KIND, OBSERVERS
from rig.observers.protocol import AnyObserver

_KEYS = (HEIGHT.key, "inputs", "further", *(quantity.key for quantity in BENCH_QUANTITIES))

DEFAULT_SETTLING_S = 0.002
"""Time constant of a filter that follows a motion: two samples at 1 kHz."""

CONFIGS = Path(__file__).parent.parent / "configs"
"""Folder of the configurations that come with the package."""

Text = Annotated[str, Field(min_length=1, max_length=255)]
SensorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class KeyName:
    """The word in capitals that stands for the keys of a mapping in the guide, such as STRUT."""

    word: str


StrutKey = Annotated[str, KeyName("STRUT")]


class OneOf:
    """Reads one of several kinds of settings, selected by the value of one key."""

    def __init__(self, key: str, choices: Mapping[str, type[object]], default: str | None) -> None:
        self._key, self.choices, self._default = key, choices, default

    def _kind(self, data: object) -> str:
        """Kind of an entry, in brackets: it is no key of the file."""
        if isinstance(data, dict):
            return f"<{cast('dict[str, object]', data).get(self._key, self._default)}>"
        return f"<{getattr(data, self._key, None)}>"

    def __get_pydantic_core_schema__(
        self, _source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        choices = {f"<{kind}>": handler.generate_schema(it) for kind, it in self.choices.items()}

        def select(data: object) -> str:
            return self._kind(data)

        select.__name__ = self._key  # which an error names
        return tagged_union_schema(choices, select)


class HeightSignal(MeasuredSignal):
    """Where a height stands on the bus, and its delay.

    Attributes:
        zero: A reading at a known length of the strut; if absent, the reading is the length.
        reversed: True if the reading falls while the height grows; requires `zero`.
        delay_s: Time from the instant that the value describes to the arrival of its frame, because
            of the sensor's filter, its cycle and the bus. The value is compared with the model's
            height at that instant.
    """

    refused_keys: ClassVar[frozenset[str]] = frozenset({"tare_n"})

    delay_s: Annotated[Finite, Field(ge=0, le=1.0)] = 0.0

    @property
    def delay_ns(self) -> int:
        """The delay in ns."""
        return round(self.delay_s * 1e9)


class InputSignal(HeightSignal):
    """Where an input of the model stands on the bus: a force, a torque, or a measured motion.

    Attributes:
        zero: Only for a motion: a reading at a known position; if absent, the reading is the
            position.
        reversed: True if the reading falls while the quantity grows; for a motion it requires
            `zero`.
        tare_n: Only for a force: reading without a force, in N after the scaling by the DBC and
            before a reversal; 0 if absent.
        delay_s: Time from the instant that the value describes to the arrival of its frame.
        acceleration: Only for a motion: where the measured acceleration of the body stands; if
            absent, the acceleration follows from the positions.
        settling_s: Only for a motion: time constant T of the filter that computes velocity and
            acceleration from the positions. The relative error of the velocity is about
            3 (T omega)^2 at the angular frequency omega of the motion.
    """

    refused_keys: ClassVar[frozenset[str]] = frozenset()

    acceleration: MeasuredSignal | None = None
    settling_s: Annotated[Finite, Field(gt=0, le=1.0)] = DEFAULT_SETTLING_S


class SensorSignal(HeightSignal):
    """A further sensor of a strut: another height, a velocity, or a load cell in the strut.

    Attributes:
        reversed: True if the reading falls while the quantity grows; requires `zero` with
            `measures: height`.
        tare_n: Reading without a force, in N after the scaling by the DBC and before a reversal; 0
            if absent.
        delay_s: Time from the instant that the value describes to the arrival of its frame.
        measures: What it measures.
    """

    measures: str

    @property
    def quantity(self) -> Quantity:
        """What it measures."""
        return STRUT_QUANTITIES[self.measures]

    @property
    def noise_std(self) -> float:
        """Standard deviation of a reading in SI, quantisation included."""
        return float(getattr(self, _noise(self.quantity).key))


def _noise(quantity: Quantity) -> SensorNoise:
    if quantity.noise is None:
        raise ValueError(f"{quantity.key}: expected the noise of a sensor that measures it")
    return quantity.noise


_MOUNTING_KEYS = {"zero": Dimension.LENGTH, "tare_n": Dimension.FORCE}
"""Keys that only sensors of one dimension have."""


def _sensor_settings(quantity: Quantity) -> type[SensorSignal]:
    """Settings of a sensor that measures a quantity of a strut."""
    noise = _noise(quantity)
    std = Annotated[Finite, Field(ge=noise.low, le=noise.high)]
    fields: dict[str, Any] = {"measures": (Literal[quantity.key], ...), noise.key: (std, ...)}
    name = f"{quantity.key.capitalize()}Sensor"
    settings = create_model(name, __base__=SensorSignal, __module__=__name__, **fields)
    settings.refused_keys = frozenset(
        key for key, dimension in _MOUNTING_KEYS.items() if quantity.dimension is not dimension
    )
    choices = ", ".join(f"`{key}`" for key in STRUT_QUANTITIES)
    settings.__doc__ = f"""{quantity.words[0].upper()}{quantity.words[1:]}.

    Attributes:
        measures: Measured quantity of the strut: {choices}.
        {noise.key}: Standard deviation of a reading, quantisation included.
    """
    return settings


SENSORS: Mapping[str, type[SensorSignal]] = {
    key: _sensor_settings(quantity) for key, quantity in STRUT_QUANTITIES.items()
}
"""What a further sensor `measures` -> its settings."""


class Signals(_Frozen):
    """What is read from the bus: heights, and quantities of the bench under their keys.

    Attributes:
        height: Measured height of each strut, by strut name.
        inputs: Inputs of the model, by their names in the model file. A model without `inputs`
            has a single force, whose signal is `applied_force`.
        further: Further sensors of a strut, by the names of strut and sensor.
        QUANTITY: A quantity for which the bench has one signal, such as `applied_force`, by its
            key in the table of measured quantities.
    """

    model_config = ConfigDict(frozen=True, extra="allow")
    __pydantic_extra__: dict[Annotated[str, KeyName("QUANTITY")], MeasuredSignal | None] = Field(  # pyright: ignore[reportIncompatibleVariableOverride] - pydantic's own way
        init=False
    )

    height: Annotated[dict[StrutKey, HeightSignal], Field(min_length=1)]
    inputs: dict[Annotated[InputName, KeyName("INPUT")], InputSignal] = Field(
        default_factory=dict[str, InputSignal]
    )
    further: dict[
        StrutKey,
        dict[
            Annotated[SensorName, KeyName("SENSOR")],
            Annotated[SensorSignal, OneOf("measures", SENSORS, None)],
        ],
    ] = Field(default_factory=dict[str, dict[str, SensorSignal]])

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: object) -> object:
        keys = list(cast("dict[object, object]", data)) if isinstance(data, dict) else []
        for key in keys:
            if key not in _KEYS:
                raise ValueError(f"{key}: unknown key, {expected_name(str(key), _KEYS)}")
        return cast("object", data)

    @property
    def bench(self) -> dict[Quantity, MeasuredSignal]:
        """Signals of the quantities of the bench, in the order of `BENCH_QUANTITIES`."""
        given = self.__pydantic_extra__
        entries = ((quantity, given.get(quantity.key)) for quantity in BENCH_QUANTITIES)
        return {quantity: signal for quantity, signal in entries if signal is not None}


class PrescribedMotion(_Frozen):
    """A dyno: the motion is prescribed, the model follows it, and the load cell measures its force.

    Attributes:
        settling_s: Time constant T of the filter that computes the velocity from the heights. The
            relative error of the velocity is about 3 (T omega)^2 at the angular frequency omega of
            the motion.
    """

    settling_s: Annotated[Finite, Field(gt=0, le=1.0)] = DEFAULT_SETTLING_S


_Observer = Annotated[AnyObserver, OneOf("kind", OBSERVERS, DEFAULT_KIND)]

Mapped = dict[Annotated[str, KeyName("QUANTITY")], SignalName]
"""Signals that publish something, by its key."""


def _is_of_one_strut(published: object) -> bool:
    """Whether the keys are publications, and not names of struts."""
    given = cast("dict[object, object]", published) if isinstance(published, dict) else {}
    keys = [item.key for item in STRUT]
    return any(key in keys or not _is_group(value) for key, value in given.items())


def _is_group(value: object) -> bool:
    """Whether a value is a group of signals, and not a signal."""
    return isinstance(value, dict) and "message" not in value and "signal" not in value


def _mapping(choices: Sequence[Publication]) -> Callable[[object], object]:
    """Reads a group of publications: signals by key, or a message that has all of them."""

    def read(data: object) -> object:
        match data:
            case str(message):
                return {item.key: {"message": message, "signal": item.signal} for item in choices}
            case dict():
                known = [item.key for item in choices]
                for key in cast("dict[object, object]", data):
                    if key not in known:
                        raise ValueError(f"{key}: unknown key, {expected_name(str(key), known)}")
                return cast("object", data)
            case _:
                return data

    return read


def _with_published_sensors(data: object) -> object:
    """A configuration whose virtual sensors have the signals that `publish` gives them."""
    given = cast("dict[object, Any]", data) if isinstance(data, dict) else {}
    sensors, published = given.get("virtual_sensors"), given.get("publish")
    if not (isinstance(sensors, dict) and isinstance(published, dict)):
        return cast("object", data)
    sensors, published = cast("_Group", sensors), cast("_Group", published)
    signals = {
        name: item for name, item in published.items() if name in sensors and not _is_group(item)
    }
    entries = {
        name: {**cast("_Group", item), "publish": signals[name]}
        if name in signals and isinstance(item, dict)
        else item
        for name, item in sensors.items()
    }
    rest = {key: value for key, value in given.items() if key != "publish"}
    others = {name: item for name, item in published.items() if name not in signals}
    return {**rest, "virtual_sensors": entries, **({"publish": others} if others else {})}


_Group = dict[object, object]


class Unsafe(_Frozen):
    """What is refused unless the user accepts the risk.

    Attributes:
        publish_without_valid: Publish a strut's force without the signal `valid`. A receiver cannot
            distinguish an invalid estimate from a valid one.
    """

    publish_without_valid: bool = False


class LogConfig(_Frozen):
    """How the log of a run is kept.

    Attributes:
        rotate_bytes: Size from which the log continues in a further file; no limit if absent.
        rotate_s: Time after which the log continues in a further file; no limit if absent.
        capture_before_s: Length of an excerpt before the fault.
        capture_after_s: Length of an excerpt after the fault.
        most_captures: Largest number of excerpts around faults in one run; 0 keeps none. An excerpt
            is kept at HOLD, SAFE, a value beyond a limit (also with the action `warn`), a fault of
            the bus or the log, and SIGUSR2.
        sync_s: Interval at which the log is flushed to the disk (`fsync`), in real time only. With
            null, the operating system decides when it flushes; this may take half a minute.
    """

    rotate_bytes: Annotated[int, Field(ge=100_000)] | None = None
    rotate_s: Annotated[Finite, Field(ge=1.0)] | None = None
    capture_before_s: Annotated[Finite, Field(ge=0.0, le=60.0)] = 2.0
    capture_after_s: Annotated[Finite, Field(ge=0.0, le=60.0)] = 2.0
    most_captures: Annotated[int, Field(ge=0, le=1000)] = 0
    sync_s: Annotated[Finite, Field(ge=0.05, le=3600.0)] | None = 1.0

    def rotation(self) -> Rotation:
        """Limits of a log file, in nanoseconds and bytes, for the writer."""
        time_ns = None if self.rotate_s is None else round(self.rotate_s * 1e9)
        return Rotation(self.rotate_bytes, time_ns)

    def window(self) -> CaptureWindow | None:
        """Time around a fault that is kept apart, for the writer; None keeps nothing apart."""
        if self.most_captures == 0:
            return None
        before_ns, after_ns = round(self.capture_before_s * 1e9), round(self.capture_after_s * 1e9)
        return CaptureWindow(before_ns, after_ns, self.most_captures)


class VirtualSensorConfig(VirtualSensor):
    """A variable of the model that is logged, plotted and published as a sensor's reading is.

    Attributes:
        publish: Signal that carries it; the same as an entry of its name under `publish`.
    """

    publish: SignalName | None = None


class RunConfig(_Frozen):
    """All of a run's configuration.

    Attributes:
        rate_hz: Ticks per second.
        duration_s: Length of the run; if absent, it lasts until Ctrl-C.
        model: Model file, relative to the configuration's folder, or the name of a shipped model.
        engine: Program that simulates the model; only `dart` is supplied.
        dbc: DBC file, relative to the configuration's folder; the package's own if absent.
        bus: Interface, channel and bit rates of the bus.
        authentication: Authentication of all frames; none if absent.
        signals: Signals that are read from the bus.
        devices: Devices that report their state, by the names of their nodes in the DBC.
        prescribed_motion: Declares a dyno: the motion is prescribed, a load cell is required, and
            an applied force and further sensors are not permitted.
        observers: Observer of each strut, by strut name; `pi` for a strut without an entry. A dyno
            uses no observer. The section Observers of this page lists the keys of each kind.
        publish: Signals that carry the quantities of each strut, by strut name and by the keys of
            the published quantities. By default RIG_ESTIMATE, RIG_KINEMATICS and (with `kalman`)
            RIG_UNCERTAINTY, if the DBC has them, for the first strut, and these names with _2, _3,
            ... for the next ones.
        status: Signals that carry the state of the bridge, by the keys of the published quantities,
            or the name of a message with the default signals. By default RIG_STATUS, if the DBC has
            it.
        timing: Signals that show how well the rate is kept, by the keys of the published
            quantities, or the name of a message. Nothing by default.
        virtual_sensors: Variables of the model that are logged, plotted and, with an entry of their
            name under `publish`, sent.
        supervision: Conditions of a valid estimate, limits and safe state.
        unsafe: Permissions that may cause damage on a bench.
        realtime: Real-time conditions that are requested from the operating system.
        log: Rotation of the log, and excerpts around faults.
    """

    rate_hz: Annotated[Finite, Field(ge=0.001, le=100_000)] = 1000.0
    duration_s: Positive | None = None
    model: Text = "reference"
    engine: Text = "dart"
    dbc: Text | None = None
    bus: BusConfig = BusConfig()
    authentication: AuthenticationSettings | None = None
    signals: Signals
    devices: dict[Annotated[SensorName, KeyName("NODE")], DeviceSettings] = Field(
        default_factory=dict[str, DeviceSettings]
    )
    prescribed_motion: PrescribedMotion | None = None
    observers: dict[StrutKey, _Observer] = Field(default_factory=dict)
    publish: dict[StrutKey, Annotated[Mapped, BeforeValidator(_mapping(STRUT))]] | None = None
    status: Annotated[Mapped, BeforeValidator(_mapping(STATUS))] | None = None
    timing: Annotated[Mapped, BeforeValidator(_mapping(TIMING))] | None = None
    virtual_sensors: dict[Annotated[SensorName, KeyName("NAME")], VirtualSensorConfig] = Field(
        default_factory=dict[str, VirtualSensorConfig]
    )
    supervision: Supervision = Supervision()
    unsafe: Unsafe = Unsafe()
    realtime: Realtime = Realtime()
    log: LogConfig = LogConfig()

    @model_validator(mode="before")
    @classmethod
    def _one_strut(cls, data: Any) -> object:
        """Let a model of one strut be measured and published without the strut's name.

        What is published of a virtual sensor becomes a part of that.
        """
        data = cast("Any", _with_published_sensors(data))
        match data:
            case {"signals": {"height": {"message": _, "signal": _} as height, **others}, **rest}:
                data = {**rest, "signals": {**others, "height": {"": height}}}
            case _:
                pass
        match data:
            case {"publish": published, **rest} if _is_of_one_strut(published):
                return {**rest, "publish": {"": published}}
            case _:
                return data

    @model_validator(mode="after")
    def _prescribed_or_driven(self) -> "RunConfig":
        if self.prescribed_motion is None:
            return self
        if self.signals.further:
            raise ValueError(
                "signals.further: expected none with prescribed_motion, which uses no observer"
            )
        if LOAD_CELL_FORCE not in self.signals.bench:
            raise ValueError("prescribed_motion: requires signals.load_cell_force")
        if self.signals.inputs:
            raise ValueError(
                "signals.inputs: expected none with prescribed_motion, which has no other drive"
            )
        if APPLIED_FORCE in self.signals.bench:
            raise ValueError(
                "prescribed_motion: expected no signals.applied_force, because a prescribed motion "
                "requires no force"
            )
        return self

    @property
    def period_ns(self) -> int:
        """Time between two ticks."""
        return round(1e9 / self.rate_hz)
