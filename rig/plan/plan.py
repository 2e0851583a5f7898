"""The plan of a run: a configuration resolved once against its model and its DBC.

Below it nothing looks up a name or opens a file.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import remainder
from pathlib import Path
from typing import TypeVar

from can_dbc.calibration import Calibration, calibrate
from can_dbc.codec import si_range, si_round, si_step
from can_dbc.database import Database, Message, alive_counter
from can_dbc.errors import DatabaseError, InputError, expected_name
from can_dbc.units import Dimension
from dart_model.spec import ModelSpec
from rig.bridge.devices import Device
from rig.bridge.incoming_messages import SHORTEST_ROUND, Alarm
from rig.bridge.outgoing_messages import PublishedSignal
from rig.bridge.published_quantities import (
    ESTIMATE,
    FORCE,
    KINEMATICS,
    STATUS,
    STATUS_MESSAGE,
    STRUT,
    TIMING,
    UNCERTAINTY,
    Publication,
)
from rig.bridge.supervision_limits import Limits
from rig.bus.secoc import FD_LENGTHS, Authentication, AuthenticationSettings
from rig.channels.channel import Channel, MeasuredSignal, Role, SignalName
from rig.channels.measured_quantities import (
    ACCELERATION,
    APPLIED_FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    MOTION,
    Quantity,
    quantity_of,
)
from rig.observers.pi import PiObserver
from rig.observers.protocol import AnyObserver
from rig.plan.config import (
    DEFAULT_SETTLING_S,
    HeightSignal,
    InputSignal,
    Mapped,
    RunConfig,
    SensorSignal,
    Signals,
)
from rig.plan.limits import resolve_limits
from rig.plan.virtual_sensors import PlannedSensor, publication_of, resolve_sensors

_LARGEST_DELAY_DIFFERENCE_S = 0.02
"""Between the sensors of one strut: a filter that goes back by more at every reading takes half a
tick of 1 kHz, and more than a tick from twice that on."""


@dataclass(frozen=True)
class PlannedStrut:
    """A strut of the model as the bridge runs it.

    Attributes:
        free_length_m: Its free length, at which a bench is assumed to rest.
        height: Channel of its measured height; None where none is measured.
        interval_ns: Time between two measurements: that of the height's message, or a tick.
        delay_ns: How much later a measurement arrives than it is true.
    """

    name: str
    free_length_m: float
    observer: AnyObserver
    height: Channel | None
    interval_ns: int
    delay_ns: int


@dataclass(frozen=True)
class PlannedInput:
    """An input of the model as the bridge drives it.

    Attributes:
        name: Its name in the model.
        is_motion: Whether a body is moved; else a force or a torque acts.
        channel: Channel that measures it; None for the single force of a bench that sends none.
        acceleration: Channel of a motion's measured acceleration, if it is measured.
        settling_s: Time constant of the filter that follows a motion.
    """

    name: str
    is_motion: bool
    channel: Channel | None
    acceleration: Channel | None
    settling_s: float


@dataclass(frozen=True)
class PlannedMessage:
    """A message that the bridge sends, and what its signals publish."""

    message: Message
    signals: tuple[PublishedSignal, ...]


@dataclass(frozen=True)
class Plan:
    """A run as it was configured, with every name resolved.

    Attributes:
        config: The configuration, with every strut and every published signal named.
        inputs: Inputs of the model, in its order.
        virtual_sensors: Variables of the model that are read as sensors are.
        channels: Channels of the bench: heights, inputs, quantities of the bench, further sensors.
        alarms: Messages with alarms of the devices, and the alarms.
        limits: Limits: the configured ones, and those that follow from the DBC.
        authentication: How frames are authenticated; None where they are not, and for the plan of
            a run, whose folder contains no key.
    """

    source: Path
    config: RunConfig
    model: ModelSpec
    database: Database
    struts: tuple[PlannedStrut, ...]
    inputs: tuple[PlannedInput, ...]
    channels: tuple[Channel, ...]
    virtual_sensors: tuple[PlannedSensor, ...]
    outgoing: tuple[PlannedMessage, ...]
    devices: tuple[Device, ...]
    alarms: tuple[tuple[Message, Alarm], ...]
    limits: Limits
    authentication: Authentication | None = None

    @property
    def period_ns(self) -> int:
        """Time between two ticks."""
        return self.config.period_ns

    @property
    def strut_names(self) -> list[str]:
        """Names of the struts."""
        return [strut.name for strut in self.struts]

    @property
    def observers(self) -> tuple[AnyObserver, ...]:
        """Observer of each strut."""
        return tuple(strut.observer for strut in self.struts)

    @property
    def heights(self) -> tuple[Channel, ...]:
        """Channels of the measured heights."""
        return tuple(channel for channel in self.channels if channel.role is Role.HEIGHT)

    @property
    def sensors(self) -> tuple[Channel, ...]:
        """Channels of further sensors."""
        return tuple(channel for channel in self.channels if channel.role is Role.SENSOR)

    @property
    def virtual_columns(self) -> list[str]:
        """Columns of the virtual sensors in the log."""
        return [column for sensor in self.virtual_sensors for column in sensor.columns]

    @property
    def is_prescribed(self) -> bool:
        """Whether the motion is prescribed: a dyno."""
        return self.config.prescribed_motion is not None

    @property
    def has_force(self) -> bool:
        """Whether a run of it can be diagnosed: what drives it, or a load cell, was measured."""
        return any(
            channel.role is Role.INPUT or channel.quantity is LOAD_CELL_FORCE
            for channel in self.channels
        )

    def bench_channel(self, quantity: Quantity) -> Channel | None:
        """Channel of a quantity of the bench; None where it is not measured."""
        for channel in self.channels:
            if channel.role is Role.BENCH and channel.quantity is quantity:
                return channel
        return None

    def messages(self) -> list[Message]:
        """Every message that the bridge reads or sends, once."""
        read = [channel.message for channel in self.channels if channel.message is not None]
        read += [message for message, _ in self.alarms]
        return list({item.name: item for item in (*read, *self.outgoing_messages())}.values())

    def outgoing_messages(self) -> list[Message]:
        """Messages that the bridge sends."""
        return [item.message for item in self.outgoing]

    def with_config(self, config: RunConfig) -> "Plan":
        """The plan of another configuration with the same model and DBC.

        Raises:
            InputError: The configuration does not fit them.
        """
        return self._resolve_again(config, self.model)

    def with_model(self, model: ModelSpec) -> "Plan":
        """The plan with another model of the same struts, such as a corrected one.

        Raises:
            InputError: The configuration does not fit it.
        """
        return self._resolve_again(self.config, model)

    def with_observers(self, observers: Mapping[str, AnyObserver]) -> "Plan":
        """The plan with other observers, by strut name.

        Raises:
            InputError: They do not fit what is measured.
        """
        every = {**self.config.observers, **observers}
        return self.with_config(self.config.model_copy(update={"observers": every}))

    def _resolve_again(self, config: RunConfig, model: ModelSpec) -> "Plan":
        plan = resolve(config, self.source, model, self.database)
        return replace(plan, authentication=self.authentication)


def resolve(config: RunConfig, source: Path, model: ModelSpec, database: Database) -> Plan:
    """Resolve a configuration against its model and its DBC.

    Raises:
        InputError: One line that names file, key, value and what was expected.
        DatabaseError: The same, of the DBC.
    """
    config = _with_names(config, model, database, source)
    applied = _input_of_applied_force(config, model, source)
    calibrated = _calibrate(config.signals, _quantities(model), database, source)
    reader = _SignalReader(config, model, calibrated, source)
    channels = reader.channels()
    sensors = resolve_sensors(
        config.virtual_sensors,
        model,
        [*config.observers, *model.drive],
        source,
        is_prescribed=config.prescribed_motion is not None,
    )
    outgoing = reader.outgoing(sensors)
    alarms = reader.alarms()
    for key, message in reader.read.items():
        if message.name in {item.message.name for item in outgoing}:
            raise InputError(
                f"{source}: {key}: {message.name} is also published, "
                "expected a message of the bench"
            )
    plan = Plan(
        source,
        config,
        model,
        database,
        _struts(config, model, channels),
        _inputs(config, model, applied, channels),
        channels,
        sensors,
        outgoing,
        _devices(config, channels),
        alarms,
        resolve_limits(
            config.supervision.limits,
            list(config.observers),
            channels,
            {
                item.strut: (planned.message, item.signal)
                for planned in outgoing
                for item in planned.signals
                if item.publication is FORCE
            },
            source,
            can_compare=(
                config.prescribed_motion is None and LOAD_CELL_FORCE in config.signals.bench
            ),
            without_std=[name for name, item in config.observers.items() if not item.knows_std],
        ),
    )
    if config.authentication is not None:
        _check_authentication(config, config.authentication, plan.messages(), source)
    _check_devices(plan)
    return plan


# --- Names ------------------------------------------------------------------------------------


_Entry = TypeVar("_Entry")


def _with_names(config: RunConfig, model: ModelSpec, database: Database, source: Path) -> RunConfig:
    """The configuration with every strut and every published signal named."""
    struts = [strut.name for strut in model.struts]
    heights = _by_strut(config.signals.height, struts, f"{source}: signals.height")
    publish = config.publish
    if publish is None:
        publish = _default_messages(struts, database, config)
    publish = _by_strut(publish, struts, f"{source}: publish")
    for key, names in (
        ("signals.height", heights),
        ("signals.further", config.signals.further),
        ("observers", config.observers),
        ("publish", publish),
    ):
        for name in names:
            if name not in struts:
                raise InputError(
                    f"{source}: {key}.{name}: no such strut, {expected_name(name, struts)}"
                )
    status = config.status
    if "status" not in config.model_fields_set:
        status = _signals_of(STATUS_MESSAGE, STATUS, database) or None
    observers = {name: config.observers.get(name, PiObserver()) for name in struts}
    _check_heights(config, observers, list(heights), source)
    height = {name: heights[name] for name in struts if name in heights}
    return config.model_copy(
        update={
            "signals": config.signals.model_copy(update={"height": height}),
            "observers": observers,
            "publish": {name: publish[name] for name in struts if name in publish},
            "status": status,
        }
    )


def _by_strut(given: Mapping[str, _Entry], struts: list[str], key: str) -> Mapping[str, _Entry]:
    """Entries by strut name, where a model of one strut may leave the name out."""
    if list(given) != [""]:
        return given
    if len(struts) > 1:
        raise InputError(
            f"{key}: the model has {len(struts)} struts, expected one entry for each of "
            f"{', '.join(struts)}"
        )
    return {struts[0]: given[""]}


def _check_heights(
    config: RunConfig, observers: Mapping[str, AnyObserver], heights: list[str], source: Path
) -> None:
    """Refuse an observer without its height, a height and sensors that no observer uses."""
    for name, observer in observers.items():
        if name not in heights and observer.requires_height:
            raise InputError(
                f"{source}: signals.height.{name}: is missing, expected its signal, or observers."
                f"{name}: {{kind: none}} for a strut whose height is not measured"
            )
    if all(observer.force_filter is None for observer in observers.values()):
        for name, observer in observers.items():
            if observer.height_std_m is not None:
                raise InputError(
                    f"{source}: observers.{name}.noise_std_m: its height corrects the filter of "
                    "other struts, expected one with kind kalman"
                )
    for name in config.signals.further:
        if not observers[name].fuses_sensors:
            raise InputError(
                f"{source}: signals.further.{name}: expected observers.{name}.kind kalman, "
                "because the others use the height alone"
            )


def _default_messages(
    struts: list[str], database: Database, config: RunConfig
) -> dict[str, Mapped]:
    messages: dict[str, Mapped] = {}
    for index, name in enumerate(struts):
        ending = "" if index == 0 else f"_{index + 1}"
        estimate = _signals_of(f"RIG_ESTIMATE{ending}", ESTIMATE, database)
        kinematics = _signals_of(f"RIG_KINEMATICS{ending}", KINEMATICS, database)
        messages[name] = {**estimate, **kinematics}
        observer = config.observers.get(name)
        if observer is not None and observer.knows_std:
            messages[name] |= _signals_of(f"RIG_UNCERTAINTY{ending}", UNCERTAINTY, database)
    return messages


def _signals_of(message: str, publications: Iterable[Publication], database: Database) -> Mapped:
    """The publications that a message has a signal of that name for, if the DBC has it."""
    if message not in database.messages:
        return {}
    signals = database.messages[message].signals
    return {
        item.key: SignalName(message=message, signal=item.signal)
        for item in publications
        if item.signal in signals
    }


# --- Signals ----------------------------------------------------------------------------------


_AS_READ = Calibration()
"""Of a sensor of which nothing is stated: what it reads is what is measured."""


def _calibrate(
    signals: Signals, inputs: Mapping[str, Quantity], database: Database, source: Path
) -> Database:
    """The DBC with the zeros, directions and tares that a configuration states."""
    known: dict[tuple[str, str], tuple[str, Calibration]] = {}
    messages = dict(database.messages)
    for key, quantity, entry in _measured(signals, inputs):
        _check_calibration(entry, quantity, f"{source}: {key}")
        message, signal = messages.get(entry.message), entry.signal
        if message is None or signal not in message.signals:
            continue  # which is refused where the channels are read
        first, calibration = known.setdefault((entry.message, signal), (key, entry.calibration))
        if calibration != entry.calibration:
            raise InputError(
                f"{source}: {key}: {entry.message}.{signal} has another zero, direction or tare "
                f"in {first}, expected the same"
            )
        if first == key and calibration != _AS_READ:
            calibrated = calibrate(message, signal, quantity.dimension, calibration)
            messages[entry.message] = calibrated
    return replace(database, messages=messages)


def _measured(
    signals: Signals, inputs: Mapping[str, Quantity]
) -> Iterator[tuple[str, Quantity, MeasuredSignal]]:
    """Everything that is measured: its key, its quantity, and where it stands."""
    for strut, entry in signals.height.items():
        yield f"signals.height.{strut}", HEIGHT, entry
    for name, entry in signals.inputs.items():
        if name in inputs:
            yield f"signals.inputs.{name}", inputs[name], entry
            if entry.acceleration is not None:
                yield f"signals.inputs.{name}.acceleration", ACCELERATION, entry.acceleration
    for quantity, entry in signals.bench.items():
        yield f"signals.{quantity.key}", quantity, entry
    for strut, group in signals.further.items():
        for sensor, entry in group.items():
            yield f"signals.further.{strut}.{sensor}", entry.quantity, entry


_REVERSIBLE = (
    Dimension.LENGTH,
    Dimension.VELOCITY,
    Dimension.ACCELERATION,
    Dimension.FORCE,
    Dimension.TORQUE,
)


def _check_calibration(entry: MeasuredSignal, quantity: Quantity, key: str) -> None:
    """Refuse a zero, direction or tare of a quantity that has none."""
    dimension = quantity.dimension
    if entry.zero is not None and dimension is not Dimension.LENGTH:
        cure = "tare_n" if dimension is Dimension.FORCE else "none"
        raise InputError(f"{key}.zero: {quantity.key} is no length, expected {cure}")
    if entry.tare_n is not None and dimension is not Dimension.FORCE:
        cure = "zero: {reads, at_m}" if dimension is Dimension.LENGTH else "none"
        raise InputError(f"{key}.tare_n: {quantity.key} is no force, expected {cure}")
    if not entry.reversed:
        return
    if dimension not in _REVERSIBLE:
        raise InputError(f"{key}.reversed: {quantity.key} has no direction, expected none")
    if dimension is Dimension.LENGTH and entry.zero is None:
        raise InputError(
            f"{key}.reversed: expected zero: {{reads, at_m}} with it, because a reversed reading "
            "alone is no length: leave it out, let rig zero measure the zero, and then set it if "
            "no second length has shown the direction"
        )


class _SignalReader:
    """Looks the configured signals up in the DBC, each once; `read` has those it reads, by key."""

    def __init__(
        self, config: RunConfig, model: ModelSpec, database: Database, source: Path
    ) -> None:
        self._config, self._database, self._source = config, database, source
        self._quantities = _quantities(model)
        self._used = [(item.message, item.signal) for item in config.signals.height.values()]
        self._of_sender: dict[tuple[str, str], str | None] = {}
        self.read: dict[str, Message] = {}

    def channels(self) -> tuple[Channel, ...]:
        """Channels of the bench: heights, inputs, quantities of the bench, further sensors."""
        signals, struts = self._config.signals, list(self._config.observers)
        channels: list[Channel] = []

        def add(
            role: Role, quantity: Quantity, name: str, key: str, strut: int, entry: MeasuredSignal
        ) -> None:
            message = self._message(entry, key)
            self._check_validity(message, entry, key)
            self._check_sender(message, entry, key)
            self._check_distinct(entry, key)
            interval_ns = message.cycle_time_ns or self._config.period_ns
            delay_ns = entry.delay_ns if isinstance(entry, HeightSignal) else 0
            noise_std = entry.noise_std if isinstance(entry, SensorSignal) else 0.0
            channels.append(
                Channel(
                    len(channels),
                    role,
                    quantity,
                    name,
                    key,
                    strut,
                    interval_ns,
                    delay_ns,
                    noise_std,
                    message,
                    entry.signal,
                    entry.valid,
                    entry.counter or "",
                    entry.time or "",
                )
            )

        for strut, entry in signals.height.items():
            index, key = struts.index(strut), f"signals.height.{strut}"
            add(Role.HEIGHT, HEIGHT, strut, key, index, entry)
        measured: dict[tuple[str, str], str] = {}
        for name, entry in signals.inputs.items():
            key, quantity = f"signals.inputs.{name}", self._quantities[name]
            self._check_input(entry, quantity, key)
            add(Role.INPUT, quantity, name, key, -1, entry)
            measured[entry.message, entry.signal] = f"inputs.{name}"
            if entry.acceleration is not None:
                further, key = f"{name}.acceleration", f"{key}.acceleration"
                add(Role.INPUT, ACCELERATION, further, key, -1, entry.acceleration)
        for quantity, entry in signals.bench.items():
            other = measured.setdefault((entry.message, entry.signal), quantity.key)
            if other != quantity.key:
                raise InputError(
                    f"{self._source}: signals.{quantity.key}: {entry.message}.{entry.signal} is "
                    f"{other} already, expected another signal"
                )
            role = Role.INPUT if quantity is APPLIED_FORCE else Role.BENCH
            add(role, quantity, quantity.key, f"signals.{quantity.key}", -1, entry)
        for strut, group in signals.further.items():
            for sensor, entry in group.items():
                self._check_sensor(strut, sensor)
                key, name = f"signals.further.{strut}.{sensor}", f"{strut}.{sensor}"
                add(Role.SENSOR, entry.quantity, name, key, struts.index(strut), entry)
        return tuple(channels)

    def outgoing(self, sensors: Sequence[PlannedSensor]) -> tuple[PlannedMessage, ...]:
        """Messages that the bridge sends, in the order in which they are named."""
        config = self._config
        published: dict[str, list[PublishedSignal]] = {}
        messages: dict[str, Message] = {}
        taken: list[SignalName] = []

        def add(key: str, entry: SignalName, publication: Publication, strut: int = 0) -> None:
            messages[entry.message] = self._signal(entry, key)
            if entry in taken:
                raise InputError(
                    f"{self._source}: {key}: signal {entry.signal} of {entry.message} stands "
                    "twice, expected once"
                )
            taken.append(entry)
            signal = PublishedSignal(entry.signal, publication, strut)
            published.setdefault(entry.message, []).append(signal)

        choices = {item.key: item for item in STRUT}
        for strut, name in enumerate(config.observers):
            for key, entry in (config.publish or {}).get(name, {}).items():
                add(f"publish.{name}.{key}", entry, choices[key], strut)
        column = 0
        for sensor in sensors:
            entry = config.virtual_sensors[sensor.name].publish
            if entry is not None:
                add(f"publish.{sensor.name}", entry, publication_of(sensor), column)
            column += len(sensor.columns)
        for group, entries, publications in (
            ("status", config.status, STATUS),
            ("timing", config.timing, TIMING),
        ):
            choices = {item.key: item for item in publications}
            for key, entry in (entries or {}).items():
                add(f"{group}.{key}", entry, choices[key])
        return tuple(PlannedMessage(messages[name], tuple(it)) for name, it in published.items())

    def alarms(self) -> tuple[tuple[Message, Alarm], ...]:
        """Alarms of the devices, with their messages."""
        return tuple(
            (
                self._message(entry, f"devices.{name}.alarms.{number}"),
                Alarm(entry.signal, index, number),
            )
            for index, (name, device) in enumerate(self._config.devices.items())
            for number, entry in enumerate(device.alarms)
        )

    def _message(self, entry: SignalName, key: str) -> Message:
        """Message of a signal that the bridge reads."""
        self.read[key] = message = self._signal(entry, key)
        return message

    def _signal(self, entry: SignalName, key: str) -> Message:
        """Message of a signal."""
        try:
            message = self._database.message(entry.message)
            message.signal(entry.signal)
        except DatabaseError as error:
            raise InputError(f"{self._source}: {key}: {error}") from error
        return message

    def _check_number(self, message: Message, name: str, key: str) -> None:
        """Refuse a signal that is no plain number of its message."""
        unit = self._signal(SignalName(message=message.name, signal=name), key).signal(name).unit
        if unit:
            raise InputError(
                f"{self._source}: {key}: {name} has the unit {unit}, expected a signal without a "
                "unit"
            )

    def _check_validity(self, message: Message, entry: MeasuredSignal, key: str) -> None:
        """Refuse a signal that cannot say that the sensor measures."""
        valid = entry.valid
        if valid is None:
            return
        self._check_number(message, valid.signal, f"{key}.valid.signal")
        low, high = si_range(message, valid.signal, Dimension.NUMBER)
        step = si_step(message, valid.signal, Dimension.NUMBER)
        is_between_steps = (
            step > 0.0
            and abs(remainder(valid.value - message.signal(valid.signal).offset, step))
            > 1e-6 * step
        )
        if is_between_steps or not low <= valid.value <= high:
            steps = f" in steps of {step:g}" if step else ""
            raise InputError(
                f"{self._source}: {key}.valid.value: {valid.value:g}, expected what "
                f"{valid.signal} can hold, {low:g} to {high:g}{steps}"
            )

    def _check_distinct(self, entry: MeasuredSignal, key: str) -> None:
        """Refuse a signal that has two meanings in one entry."""
        meaning = {entry.signal: "signal"}
        valid = entry.valid.signal if entry.valid is not None else None
        for name, signal in (
            ("valid.signal", valid),
            ("counter", entry.counter),
            ("time", entry.time),
        ):
            if signal is not None and meaning.setdefault(signal, name) != name:
                raise InputError(
                    f"{self._source}: {key}.{name}: {signal} is {meaning[signal]} already, "
                    "expected another signal"
                )

    def _check_sender(self, message: Message, entry: MeasuredSignal, key: str) -> None:
        """Refuse a counter or time signal that cannot be one, or another than the message has."""
        if entry.counter is not None:
            where = f"{self._source}: {key}.counter"
            self._check_number(message, entry.counter, f"{key}.counter")
            if message.protection is not None:
                raise InputError(
                    f"{where}: {message.name} is protected, expected none: its counter is "
                    f"{message.protection.counter_signal}"
                )
            try:
                alive_counter(message, entry.counter)
            except DatabaseError as error:
                raise InputError(f"{where}: {error}") from error
        if entry.time is not None:
            self._signal(SignalName(message=message.name, signal=entry.time), f"{key}.time")
            self._check_time(message, entry.time, f"{self._source}: {key}.time")
        for name, own in (("counter", entry.counter), ("time", entry.time)):
            known = self._of_sender.setdefault((message.name, name), own)
            if own != known:
                raise InputError(
                    f"{self._source}: {key}.{name}: {own or 'none'}, expected {known or 'none'}, "
                    f"as for the other signals of {message.name}"
                )

    def _check_time(self, message: Message, name: str, where: str) -> None:
        """Refuse a time signal that begins again too soon, or whose steps are too long."""
        cycle_s = (message.cycle_time_ns or self._config.period_ns) * 1e-9
        try:
            round_s = si_round(message, name, Dimension.TIME)
            step_s = si_step(message, name, Dimension.TIME)
        except DatabaseError as error:
            raise InputError(f"{where}: {error}") from error
        if step_s > cycle_s:
            raise InputError(
                f"{where}: {name} has steps of {step_s:g} s, expected at most a cycle ({cycle_s:g} "
                "s): one that does not change is taken for the same sample"
            )
        if round_s < SHORTEST_ROUND * cycle_s:
            raise InputError(
                f"{where}: {name} begins again after {round_s:g} s, expected at "
                f"least {SHORTEST_ROUND} cycles of {cycle_s:g} s (is its range in the DBC right?)"
            )

    def _check_input(self, entry: InputSignal, quantity: Quantity, key: str) -> None:
        """Refuse what only a motion has."""
        if quantity is MOTION:
            return
        for field in ("acceleration", "settling_s"):
            if field in entry.model_fields_set:
                raise InputError(
                    f"{self._source}: {key}.{field}: expected none, because the input is no motion"
                )

    def _check_sensor(self, strut: str, sensor: str) -> None:
        """Refuse a further sensor whose signal is in use, or whose delay differs too much."""
        signals = self._config.signals
        entry, key = signals.further[strut][sensor], f"signals.further.{strut}.{sensor}"
        if (entry.message, entry.signal) in self._used:
            raise InputError(
                f"{self._source}: {key}: {entry.message}.{entry.signal} is a height or "
                "a further sensor already, expected another signal"
            )
        self._used.append((entry.message, entry.signal))
        own_s = signals.height[strut].delay_s if strut in signals.height else 0.0
        if abs(entry.delay_s - own_s) > _LARGEST_DELAY_DIFFERENCE_S:
            raise InputError(
                f"{self._source}: {key}.delay_s: {entry.delay_s:g}: expected at most "
                f"{_LARGEST_DELAY_DIFFERENCE_S:g} s more or less than that of the height "
                f"({own_s:g})"
            )


def _struts(
    config: RunConfig, model: ModelSpec, channels: Sequence[Channel]
) -> tuple[PlannedStrut, ...]:
    heights = {channel.strut: channel for channel in channels if channel.role is Role.HEIGHT}
    struts: list[PlannedStrut] = []
    for index, strut in enumerate(model.struts):
        height = heights.get(index)
        interval_ns, delay_ns = config.period_ns, 0
        if height is not None:
            interval_ns, delay_ns = height.interval_ns, height.delay_ns
        observer = config.observers[strut.name]
        struts.append(
            PlannedStrut(strut.name, strut.free_length_m, observer, height, interval_ns, delay_ns)
        )
    return tuple(struts)


# --- Inputs -------------------------------------------------------------------------------------


def _quantities(model: ModelSpec) -> dict[str, Quantity]:
    """What is measured of each input of a model, by its name."""
    return {name: quantity_of(item) for name, item in model.drive.items()}


def _input_of_applied_force(config: RunConfig, model: ModelSpec, source: Path) -> str | None:
    """The input of the model that `signals.applied_force` is; None where it is not measured.

    Raises:
        InputError: An input is not the model's, is measured twice, or is not measured.
    """
    signals, quantities = config.signals, _quantities(model)
    for name in signals.inputs:
        if name not in quantities or model.inputs is None:
            expected = expected_name(name, list(model.inputs or ()))
            if model.inputs is None:
                expected = f"the model has no inputs, expected signals.{APPLIED_FORCE.key}"
            raise InputError(f"{source}: signals.inputs.{name}: {expected}")
    measured = set(signals.inputs)
    applied = None
    if APPLIED_FORCE in signals.bench:
        forces = [name for name, quantity in quantities.items() if quantity is APPLIED_FORCE]
        if len(forces) != 1 or forces[0] in measured:
            raise InputError(
                f"{source}: signals.{APPLIED_FORCE.key}: expected signals.inputs with each input "
                f"of the model by its name: {', '.join(quantities)}"
            )
        applied = forces[0]
        measured.add(applied)
    if model.inputs is not None and config.prescribed_motion is None:
        for name in quantities:
            if name not in measured:
                raise InputError(
                    f"{source}: signals.inputs.{name}: is missing, expected its signal, because "
                    "the model has this input"
                )
    return applied


def _inputs(
    config: RunConfig, model: ModelSpec, applied: str | None, channels: Sequence[Channel]
) -> tuple[PlannedInput, ...]:
    by_name = {channel.name: channel for channel in channels if channel.role is Role.INPUT}
    planned: list[PlannedInput] = []
    for name, quantity in _quantities(model).items():
        entry = config.signals.inputs.get(name)
        planned.append(
            PlannedInput(
                name,
                quantity is MOTION,
                by_name.get(APPLIED_FORCE.key if name == applied else name),
                by_name.get(f"{name}.acceleration"),
                DEFAULT_SETTLING_S if entry is None else entry.settling_s,
            )
        )
    return tuple(planned)


# --- Devices and authentication -----------------------------------------------------------------


def vital_channels(config: RunConfig, channels: Sequence[Channel]) -> list[Channel]:
    """Those that an estimate rests on: heights, and what drives the bench or its load cell."""
    is_prescribed = config.prescribed_motion is not None
    return [
        it
        for it in channels
        if it.role in (Role.HEIGHT, Role.INPUT)
        or (is_prescribed and it.quantity is LOAD_CELL_FORCE)
    ]


def _devices(config: RunConfig, channels: Sequence[Channel]) -> tuple[Device, ...]:
    """Devices that are watched."""
    vital = {
        channel.message.sender
        for channel in vital_channels(config, channels)
        if channel.message is not None
    }
    return tuple(
        entry.device(name, is_vital=name in vital) for name, entry in config.devices.items()
    )


def _check_devices(plan: Plan) -> None:
    """Refuse devices that send nothing that is used, and ids that are in use already."""
    config, database = plan.config, plan.database
    read = {channel.message.name: channel.message for channel in plan.channels if channel.message}
    read |= {message.name: message for message, _ in plan.alarms}
    taken = {
        message.arbitration_id: message.name
        for message in plan.messages()
        if not message.is_extended
    }
    senders = sorted({message.sender for message in read.values() if message.sender})
    for device, (name, entry) in zip(plan.devices, config.devices.items(), strict=True):
        key = f"{plan.source}: devices.{name}"
        if config.authentication is not None:
            raise InputError(f"{key}: expected none with authentication, which it does not support")
        if name not in senders:
            raise InputError(
                f"{key}: sends none of the signals in {database.path.name}, expected the name of "
                f"a node that does: {', '.join(senders) or 'the DBC names none'}"
            )
        other = next(
            (item.name for item in read.values() if item.sender == name and not item.is_j1939), None
        )
        if entry.j1939_name is not None and other is not None:
            raise InputError(f"{key}.j1939_name: {other} is no message of J1939 in the DBC")
        if any(entry.alarms.count(alarm) > 1 for alarm in entry.alarms):
            raise InputError(f"{key}.alarms: a signal stands twice, expected it once")
        _check_ids(device, taken, key)
    for message, alarm in plan.alarms:
        device = plan.devices[alarm.device]
        signal = message.signal(alarm.signal)
        if message.sender != device.name or signal.is_float or signal.scale != 1 or signal.offset:
            raise InputError(
                f"{plan.source}: devices.{device.name}.alarms.{alarm.alarm}: "
                f"{message.name}.{alarm.signal}: expected an integer without scale and offset "
                f"that {device.name} sends"
            )


def _check_ids(device: Device, taken: dict[int, str], key: str) -> None:
    """Refuse ids of a device that are in use; the others are then."""
    ids = device.ids
    if len(set(ids)) < len(ids):
        raise InputError(f"{key}.emergency_id: {ids[0]:#x} is the id of its heartbeats")
    for arbitration_id in ids:
        other = taken.setdefault(arbitration_id, f"devices.{device.name}")
        if other != f"devices.{device.name}":
            raise InputError(
                f"{key}: {arbitration_id:#x} is an id of {other} already, expected another "
                "node_id or emergency_id"
            )


def _check_authentication(
    config: RunConfig, settings: AuthenticationSettings, messages: list[Message], source: Path
) -> None:
    """Refuse messages that have no room for authentication."""
    if config.bus.data_bitrate is None:
        raise InputError(
            f"{source}: authentication: classic CAN has no room for it, expected bus.data_bitrate"
        )
    for message in sorted(messages, key=lambda item: item.name):
        if message.is_extended:
            raise InputError(
                f"{source}: authentication: {message.name} has a 29-bit id, expected 11 bits, "
                "because SecOC's data ids have 16"
            )
        length = message.length_bytes + settings.trailer_bytes
        if length not in FD_LENGTHS:
            raise InputError(
                f"{source}: authentication: {message.name} would be {length} bytes long, "
                f"expected one of CAN FD's lengths {', '.join(map(str, FD_LENGTHS))}"
            )
