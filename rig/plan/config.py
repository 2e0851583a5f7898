"""Configuration of the bridge: YAML -> frozen values, validated once."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    model_validator,
)
from pydantic_core import CoreSchema
from pydantic_core.core_schema import tagged_union_schema

from can_dbc.yaml_file import Finite, Positive
from rig.bridge.contract import Observer
from rig.bridge.devices import LARGEST_NODE_ID, Device
from rig.bridge.messages import STATUS, STRUT, TIMING, Publication
from rig.bridge.supervisor import Action, Limit, Supervision, Watched
from rig.bus.bus import BusConfig
from rig.bus.secoc import Authentication
from rig.log.captures import CaptureWindow
from rig.log.rotation import Rotation
from rig.observers import DEFAULT_KIND, OBSERVERS
from rig.plan.quantities import APPLIED_FORCE, HEIGHT, LOAD_CELL_FORCE, OTHERS, Quantity

_EMERGENCY_ID = 0x080
_KEYS = (HEIGHT.key, "further", *(quantity.key for quantity in OTHERS))

CONFIGS = Path(__file__).parent.parent / "configs"
"""Folder of the configurations that come with the package."""

Text = Annotated[str, Field(min_length=1, max_length=255)]
SensorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SignalName(_Frozen):
    """Where a value stands on the bus.

    Attributes:
        message: Message of the DBC.
        signal: Signal of the message; its unit is converted.
    """

    message: Text
    signal: Text


class HeightSignal(SignalName):
    """Where a height stands on the bus, and how late it comes.

    Attributes:
        message: Message of the DBC.
        signal: Signal of the message; its unit is converted.
        delay_s: How much later its frame comes than it was true: filters of the sensor, its cycle,
            the bus. The model's height of that time is compared with it.
    """

    delay_s: Annotated[float, Field(ge=0, le=1.0, allow_inf_nan=False)] = 0.0

    @property
    def delay_ns(self) -> int:
        """The delay in ns."""
        return round(self.delay_s * 1e9)


class FurtherHeight(HeightSignal):
    """Another height of a strut.

    Attributes:
        measures: Tag.
        noise_std_m: Standard deviation of a reading, quantisation included.
    """

    measures: Literal["height"]
    noise_std_m: Annotated[float, Field(ge=1e-9, le=1.0)]

    @property
    def noise_std(self) -> float:
        """In SI."""
        return self.noise_std_m


class FurtherVelocity(HeightSignal):
    """A velocity of the height, positive in rebound.

    Attributes:
        measures: Tag.
        noise_std_m_per_s: Standard deviation of a reading, quantisation included.
    """

    measures: Literal["velocity"]
    noise_std_m_per_s: Annotated[float, Field(ge=1e-7, le=100.0)]

    @property
    def noise_std(self) -> float:
        """In SI."""
        return self.noise_std_m_per_s


class FurtherForce(HeightSignal):
    """A load cell in the strut, positive when the strut pushes.

    Attributes:
        measures: Tag.
        noise_std_n: Standard deviation of a reading, quantisation included.
    """

    measures: Literal["force"]
    noise_std_n: Annotated[float, Field(ge=1e-4, le=1e7)]

    @property
    def noise_std(self) -> float:
        """In SI."""
        return self.noise_std_n


FurtherSensor = Annotated[
    FurtherHeight | FurtherVelocity | FurtherForce, Field(discriminator="measures")
]


class Signals(_Frozen):
    """What is read from the bus: heights, and any other quantity of `OTHERS` under its key.

    Attributes:
        height: Measured height of each strut, by strut name.
        further: Sensors beside it, by the names of strut and sensor.
    """

    model_config = ConfigDict(frozen=True, extra="allow")
    __pydantic_extra__: dict[str, SignalName | None] = Field(  # pyright: ignore[reportIncompatibleVariableOverride] - pydantic's own way
        init=False
    )

    height: Annotated[dict[str, HeightSignal], Field(min_length=1)]
    further: dict[str, dict[SensorName, FurtherSensor]] = Field(
        default_factory=dict[str, dict[str, FurtherSensor]]
    )

    @model_validator(mode="before")
    @classmethod
    def _known(cls, data: object) -> object:
        keys = list(cast("dict[object, object]", data)) if isinstance(data, dict) else []
        for key in keys:
            if key not in _KEYS:
                raise ValueError(f"{key}: unknown key, expected one of {', '.join(_KEYS)}")
        return cast("object", data)

    @property
    def others(self) -> dict[Quantity, SignalName]:
        """Signals of the quantities beside heights, in the order of `OTHERS`."""
        given = self.__pydantic_extra__
        found = ((quantity, given.get(quantity.key)) for quantity in OTHERS)
        return {quantity: signal for quantity, signal in found if signal is not None}

    @property
    def measured(self) -> tuple[Quantity, ...]:
        """Quantities beside heights that the bench sends."""
        return tuple(self.others)

    def sensors(self) -> list[tuple[str, str, FurtherHeight | FurtherVelocity | FurtherForce]]:
        """Further sensors: name with the strut's before it, strut, and the sensor itself."""
        return [
            (f"{strut}.{name}", strut, entry)
            for strut, group in self.further.items()
            for name, entry in group.items()
        ]

    def named(self) -> dict[str, SignalName]:
        """All signals by their keys, heights first."""
        further: dict[str, SignalName] = {
            f"signals.further.{name}": entry for name, _, entry in self.sensors()
        }
        heights: dict[str, SignalName] = {
            f"signals.height.{name}": entry for name, entry in self.height.items()
        }
        others = {f"signals.{quantity.key}": entry for quantity, entry in self.others.items()}
        return {**heights, **others, **further}


def _observer_kind(data: object) -> object:
    """Which of `OBSERVERS` an entry is, in brackets: it is no key of the file."""
    if isinstance(data, dict):
        return f"<{cast('dict[str, object]', data).get('kind', DEFAULT_KIND)}>"
    return f"<{getattr(data, 'kind', None)}>"


class _OneOfObservers:
    """How pydantic reads one of `OBSERVERS`, by its `kind`."""

    @classmethod
    def __get_pydantic_core_schema__(
        cls, _source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        choices = {f"<{kind}>": handler.generate_schema(made) for kind, made in OBSERVERS.items()}
        return tagged_union_schema(choices, _observer_kind)


class PrescribedMotion(_Frozen):
    """A dyno: the motion is prescribed, the model follows it, and the load cell measures.

    Attributes:
        settling_s: Time constant with which older heights fade in the velocity that the model is
            given; the velocity errs by three times the square of its product with the motion's
            angular frequency.
    """

    settling_s: Annotated[float, Field(gt=0, le=1.0, allow_inf_nan=False)] = 0.002


Mapped = dict[str, SignalName]
"""What is published, by its key, and where it stands on the bus."""


def _is_of_one_strut(published: object) -> bool:
    """Whether its keys are publications, and not names of struts."""
    given = cast("dict[object, object]", published) if isinstance(published, dict) else {}
    keys = [item.key for item in STRUT]
    return any(key in keys or not _is_group(value) for key, value in given.items())


def _is_group(value: object) -> bool:
    """Whether it is what one strut publishes, and not a signal."""
    return isinstance(value, dict) and "message" not in value and "signal" not in value


def _mapping(choices: Sequence[Publication]) -> Callable[[object], object]:
    """Reads a group of publications: signals by key, or a message that has all of them.

    Args:
        choices: What may be published.
    """

    def read(data: object) -> object:
        match data:
            case str(message):
                return {item.key: {"message": message, "signal": item.signal} for item in choices}
            case dict():
                known = [item.key for item in choices]
                for key in cast("dict[object, object]", data):
                    if key not in known:
                        raise ValueError(f"{key}: unknown key, expected one of {', '.join(known)}")
                return cast("object", data)
            case _:
                return data

    return read


class DeviceConfig(_Frozen):
    """A device that says how it is; its frames are refused while something is wrong.

    Attributes:
        node_id: CANopen node id; a device has this or a NAME.
        emergency_id: Arbitration id of its emergency frames; 128 and the node id if absent.
        heartbeat_s: Longest time between two heartbeats; they are not watched if absent.
        alarms: Signals that are other than zero while something is wrong with it.
        j1939_name: NAME of a J1939 device: 64 bits, as it claims its address with.
        source_address: Address of a J1939 device at the start; a claim later on changes it.
    """

    node_id: Annotated[int, Field(ge=1, le=LARGEST_NODE_ID, strict=True)] | None = None
    emergency_id: Annotated[int, Field(ge=1, le=0x7FF, strict=True)] | None = None
    heartbeat_s: Annotated[float, Field(ge=0.001, le=165.0, allow_inf_nan=False)] | None = None
    alarms: Annotated[tuple[SignalName, ...], Field(max_length=16)] = ()
    j1939_name: Annotated[int, Field(ge=0, lt=2**64, strict=True)] | None = None
    source_address: Annotated[int, Field(ge=0, le=253, strict=True)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "DeviceConfig":
        of_canopen = (self.node_id, self.emergency_id, self.heartbeat_s)
        of_j1939 = (self.j1939_name, self.source_address)
        is_canopen = self.node_id is not None and of_j1939 == (None, None)
        if not is_canopen and (of_canopen != (None, None, None) or None in of_j1939):
            raise ValueError(
                "expected node_id, with emergency_id and heartbeat_s if wanted, or j1939_name and "
                "source_address"
            )
        return self

    def device(self, name: str, *, is_vital: bool) -> Device:
        """As the core takes it."""
        node_id = self.node_id or 0
        device = Device(
            name,
            node_id,
            self.emergency_id or _EMERGENCY_ID + node_id,
            round((self.heartbeat_s or 0.0) * 1e9),
            len(self.alarms),
            is_vital,
        )
        if self.j1939_name is None or self.source_address is None:
            return device
        return device._replace(j1939_name=self.j1939_name, address=self.source_address)


class LimitConfig(_Frozen):
    """One row of the table of limits, for every strut.

    Attributes:
        value: What is limited, with its unit. Of the measurement: `measured_height_m`,
            `measured_rate_m_per_s`, `unchanged_s` (how long it may stay exactly the same). Of the
            estimate: `height_m`, `force_n`, `virtual_force_n`, `innovation_m`.
        low: Smallest value within.
        high: Largest value within.
        action: `warn` reports it in the status; `refuse` drops the measurement; `hold` marks the
            estimate invalid as long as it lasts; `safe` enters the safe state.
    """

    value: Watched
    low: Finite | None = None
    high: Finite | None = None
    action: Literal["warn", "refuse", "hold", "safe"]

    @model_validator(mode="after")
    def _sensible(self) -> "LimitConfig":
        if self.low is None and self.high is None:
            raise ValueError(f"{self.value.value}: expected low, high or both")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low {self.low}: expected less than high ({self.high})")
        if self.action == "refuse" and not self.value.is_measured:
            raise ValueError(
                f"action refuse of {self.value.value}: expected warn, hold or safe, "
                "because only a measurement can be refused"
            )
        return self

    def limit(self) -> Limit:
        """As the core takes it."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return Limit(self.value, low, high, Action[self.action.upper()])


class SupervisionConfig(_Frozen):
    """Ages of the measurement, the output of the safe state, and the table of limits.

    Attributes:
        stale_after_s: Age of a height from which the estimate is marked invalid.
        safe_after_s: Age from which the safe state is entered.
        safe_output: Force that the safe state publishes: `zero`, or the `last` valid one.
        limits: What is done beyond which values, row by row.
    """

    stale_after_s: Positive = 0.01
    safe_after_s: Positive = 0.5
    safe_output: Literal["zero", "last"] = "zero"
    limits: Annotated[tuple[LimitConfig, ...], Field(max_length=100)] = ()

    @model_validator(mode="after")
    def _in_order(self) -> "SupervisionConfig":
        if self.safe_after_s < self.stale_after_s:
            raise ValueError(
                f"safe_after_s {self.safe_after_s}: expected at least stale_after_s "
                f"({self.stale_after_s})"
            )
        return self

    def supervision(self) -> Supervision:
        """As the core takes it."""
        return Supervision(
            round(self.stale_after_s * 1e9),
            round(self.safe_after_s * 1e9),
            self.safe_output == "last",
            tuple(row.limit() for row in self.limits),
        )


class BusSettings(_Frozen):
    """How to open the bus.

    Attributes:
        interface: python-can's name of the interface: `socketcan`, `pcan`, `slcan`, `virtual`, ...
        channel: Channel of the interface.
        bitrate: Bit rate in bit/s.
        data_bitrate: Bit rate of CAN FD payloads in bit/s; classic CAN if absent.
        options: Further arguments, which go to python-can's interface as they are.
    """

    interface: Text = "virtual"
    channel: Text = "rig"
    bitrate: Annotated[int, Field(gt=0, le=1_000_000_000)] = 1_000_000
    data_bitrate: Annotated[int, Field(gt=0, le=1_000_000_000)] | None = None
    options: dict[str, Any] = Field(default_factory=dict[str, Any])

    def config(self) -> BusConfig:
        """As the bus takes it."""
        return BusConfig(
            self.interface, self.channel, self.bitrate, self.data_bitrate, self.options
        )


class Realtime(_Frozen):
    """What is asked of the machine; every key works without being granted.

    Attributes:
        fifo_priority: Priority under SCHED_FIFO; 0 asks for none.
        lock_memory: Keep all pages in memory.
        cpu: Core on which the loop runs.
        spin_s: How long to spin before a deadline where SCHED_FIFO was granted.
        freeze_garbage: Collect garbage before the run and not during it.
    """

    fifo_priority: Annotated[int, Field(ge=0, le=99)] = 50
    lock_memory: bool = True
    cpu: Annotated[int, Field(ge=0, le=65_535)] | None = None
    spin_s: Annotated[float, Field(ge=0, le=0.01)] = 0.0002
    freeze_garbage: bool = True


class AuthenticationConfig(_Frozen):
    """Authentication of all frames after AUTOSAR SecOC, on CAN FD.

    Attributes:
        key_file: File with 32 hexadecimal digits, beside the configuration.
        freshness_bits: Bits of the freshness value in a frame.
        mac_bits: Bits of the CMAC in a frame.
        clock_tolerance_s: How far bench's and bridge's clocks may be apart. A frame that was
            recorded longer ago is refused also by a bridge that has just been started.
    """

    key_file: Text
    freshness_bits: Literal[8, 16, 24, 32] = 8
    mac_bits: Literal[24, 32, 40, 48, 56, 64, 96, 128] = 24
    clock_tolerance_s: Annotated[float, Field(ge=0.001, le=10.0, allow_inf_nan=False)] = 0.1

    def with_key(self, key: bytes) -> Authentication:
        """As the bus takes it."""
        tolerance_ns = round(self.clock_tolerance_s * 1e9)
        return Authentication(key, self.freshness_bits // 8, self.mac_bits // 8, tolerance_ns)

    @property
    def trailer_bytes(self) -> int:
        """How much longer a frame becomes."""
        return (self.freshness_bits + self.mac_bits) // 8


class LogConfig(_Frozen):
    """How the log of a run is kept.

    Attributes:
        rotate_bytes: Size at which the log is continued in further files; never if absent.
        rotate_s: Time after which it is.
        capture_before_s: Time before a fault that is kept apart.
        capture_after_s: Time after it.
        most_captures: Windows kept apart in one run; 0 for none. A window is opened by HOLD, SAFE,
            a fault of bus or log, and SIGUSR2.
    """

    rotate_bytes: Annotated[int, Field(ge=100_000)] | None = None
    rotate_s: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] | None = None
    capture_before_s: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0
    capture_after_s: Annotated[float, Field(ge=0.0, le=60.0)] = 2.0
    most_captures: Annotated[int, Field(ge=0, le=1000)] = 0

    def rotation(self) -> Rotation:
        """As the log takes it."""
        time_ns = None if self.rotate_s is None else round(self.rotate_s * 1e9)
        return Rotation(self.rotate_bytes, time_ns)

    def window(self) -> CaptureWindow | None:
        """As the log takes it; None captures nothing."""
        if self.most_captures == 0:
            return None
        before_ns, after_ns = round(self.capture_before_s * 1e9), round(self.capture_after_s * 1e9)
        return CaptureWindow(before_ns, after_ns, self.most_captures)


class RunConfig(_Frozen):
    """All of a run's configuration.

    Attributes:
        rate_hz: Ticks a second.
        duration_s: Length of the run; until Ctrl-C if absent.
        model: Model file, beside the configuration, or the name of one that comes with the package.
        engine: What simulates the model.
        dbc: DBC file beside the configuration; the package's own if absent.
        bus: How to open the bus.
        authentication: Authentication of all frames; none if absent.
        signals: What is read from it.
        devices: Devices that say how they are, by the names of their nodes in the DBC.
        prescribed_motion: Declares a dyno; there is then a load cell and no applied force.
        observers: One for each strut of the model, by strut name; PI where none is named.
            `kind` says which, `pi` if absent; its other keys are its own. A dyno uses none.
        publish: What is published of each strut, by strut name: signals by the keys of
            `rig.bridge.messages.STRUT`. By default, where the DBC has them, RIG_ESTIMATE and
            RIG_KINEMATICS for the first strut, and the same with _2, _3, ... for the next ones.
        status: What is published of the bridge, by the keys of `rig.bridge.messages.STATUS`; or a
            message that has a signal of each name. By default RIG_STATUS, where the DBC has it.
        timing: How well the rate is kept, by the keys of `rig.bridge.messages.TIMING`, or a
            message;
            nothing by default.
        supervision: Ages and safe state.
        realtime: What is asked of the machine.
        log: Rotation, and windows that are kept apart.
    """

    rate_hz: Annotated[Finite, Field(ge=0.001, le=100_000)] = 1000.0
    duration_s: Positive | None = None
    model: Text = "reference"
    engine: Text = "dart"
    dbc: Text | None = None
    bus: BusSettings = BusSettings()
    authentication: AuthenticationConfig | None = None
    signals: Signals
    devices: dict[SensorName, DeviceConfig] = Field(default_factory=dict[str, DeviceConfig])
    prescribed_motion: PrescribedMotion | None = None
    observers: dict[str, Annotated[Observer, _OneOfObservers]] = Field(default_factory=dict)
    publish: dict[str, Annotated[Mapped, BeforeValidator(_mapping(STRUT))]] | None = None
    status: Annotated[Mapped, BeforeValidator(_mapping(STATUS))] | None = None
    timing: Annotated[Mapped, BeforeValidator(_mapping(TIMING))] | None = None
    supervision: SupervisionConfig = SupervisionConfig()
    realtime: Realtime = Realtime()
    log: LogConfig = LogConfig()

    @model_validator(mode="before")
    @classmethod
    def _one_strut(cls, data: Any) -> Any:
        """Let a model of one strut say what is measured and published without the strut's name."""
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
                "signals.further: expected none beside prescribed_motion, which uses no observer"
            )
        if LOAD_CELL_FORCE not in self.signals.others:
            raise ValueError("prescribed_motion: expected signals.load_cell_force beside it")
        if APPLIED_FORCE in self.signals.others:
            raise ValueError(
                "prescribed_motion: expected no signals.applied_force beside it, because a motion "
                "that is prescribed asks for no force"
            )
        return self

    def subscribed(self) -> dict[str, SignalName]:
        """Every signal that the bridge reads, by its key."""
        alarms = {
            f"devices.{name}.alarms.{place}": entry
            for name, device in self.devices.items()
            for place, entry in enumerate(device.alarms)
        }
        return {**self.signals.named(), **alarms}

    def published(self) -> dict[str, SignalName]:
        """Every signal that the bridge sends, by its key."""
        groups = {f"publish.{strut}": group for strut, group in (self.publish or {}).items()}
        groups |= {"status": self.status or {}, "timing": self.timing or {}}
        return {
            f"{name}.{key}": entry for name, group in groups.items() for key, entry in group.items()
        }

    def published_messages(self) -> list[str]:
        """Names of all messages that the bridge sends."""
        return list(dict.fromkeys(entry.message for entry in self.published().values()))

    @property
    def period_ns(self) -> int:
        """Time between two ticks."""
        return round(1e9 / self.rate_hz)
