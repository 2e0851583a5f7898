"""A configuration with the files it names, read and checked against each other."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict

from can_dbc.database import DEFAULT_DATABASE, Database, Message, load_database
from can_dbc.errors import DatabaseError, InputError
from can_dbc.yaml_file import load_yaml, validate
from dart_model.spec import ModelSpec, load_model, model_file
from rig.bridge.messages import ESTIMATE, KINEMATICS, STATUS, UNCERTAINTY, Publication
from rig.bus.secoc import FD_LENGTHS, Authentication, read_key
from rig.log.file_names import DBC_FILE, MODEL_FILE, RUN_FILE
from rig.log.reader import read_header
from rig.observers.kalman import KalmanObserver
from rig.observers.none import NoObserver
from rig.observers.pi import PiObserver
from rig.plan.config import (
    AuthenticationConfig,
    HeightSignal,
    Mapped,
    RunConfig,
    SignalName,
)

_MOST_APART_S = 0.02
"""By which delays of one strut's sensors may differ: a filter that goes back by more at every
reading takes half a tick of 1 kHz, and more than a tick from twice that on."""


class Setup(BaseModel):
    """A configuration with the files it names, read and checked against each other.

    Attributes:
        config: The configuration, with every strut named.
        source: File it came from.
        model: The model.
        database: The DBC.
    """

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    config: RunConfig
    source: Path
    model: ModelSpec
    database: Database


def load_setup(path: Path, *, model: str | None = None, duration_s: float | None = None) -> Setup:
    """A configuration and all files it names.

    Args:
        path: YAML file.
        model: File or name of a model to use instead of the configuration's.
        duration_s: A length to use instead of the configuration's.

    Raises:
        InputError: One line that names file, key, value and what was expected.
        DatabaseError: The same, of the DBC.
    """
    config = load_yaml(RunConfig, path)
    if duration_s is not None:
        if not 0.0 < duration_s < float("inf"):
            raise InputError(f"--duration-s {duration_s}: expected a finite number above zero")
        config = config.model_copy(update={"duration_s": duration_s})
    return setup(config, path, None if model is None else model_file(model, Path()))


def setup(config: RunConfig, source: Path, model_path: Path | None = None) -> Setup:
    """A configuration with the files it names.

    Args:
        config: The configuration.
        source: File it came from; what it names lies beside it.
        model_path: A model to use instead of the configuration's.

    Raises:
        InputError: One line that names file, key, value and what was expected.
        DatabaseError: The same, of the DBC.
    """
    model = load_model(model_path or _model_path(config.model, source))
    database = load_database(DEFAULT_DATABASE if config.dbc is None else source.parent / config.dbc)
    return put_together(config, source, model, database)


def setup_of_folder(folder: Path) -> Setup:
    """The configuration, model and DBC that a run goes on with, or went.

    Raises:
        InputError: A file of the run is missing or damaged.
        DatabaseError: Its DBC is.
    """
    source = folder / RUN_FILE
    config = validate(RunConfig, read_header(folder).get("config"), f"{source}: config")
    model, database = load_model(folder / MODEL_FILE), load_database(folder / DBC_FILE)
    return put_together(config, source, model, database)


def put_together(config: RunConfig, source: Path, model: ModelSpec, database: Database) -> Setup:
    """A configuration with what it names, checked against each other.

    Raises:
        InputError: One line that names file, key, value and what was expected.
        DatabaseError: The same, of the DBC.
    """
    named = _with_names(config, model, database, source)
    _check_messages(named, database, source)
    _check_devices(named, database, source)
    return Setup(config=named, source=source, model=model, database=database)


def load_authentication(ready: Setup) -> Authentication | None:
    """How frames are authenticated, with its key; None without authentication.

    Raises:
        InputError: The key cannot be read.
    """
    asked = ready.config.authentication
    return None if asked is None else asked.with_key(read_key(ready.source.parent / asked.key_file))


def _model_path(name: str, source: Path) -> Path:
    try:
        return model_file(name, source.parent)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _with_names(config: RunConfig, model: ModelSpec, database: Database, source: Path) -> RunConfig:
    """The configuration with every strut and every published signal named."""
    struts = [strut.name for strut in model.struts]
    heights = _named(config.signals.height, struts, f"{source}: signals.height")
    publish = config.publish
    if publish is None:
        publish = _default_messages(struts, database, config)
    publish = _named(publish, struts, f"{source}: publish")
    for key, names in (
        ("signals.height", heights),
        ("signals.further", config.signals.further),
        ("observers", config.observers),
        ("publish", publish),
    ):
        for name in names:
            if name not in struts:
                raise InputError(
                    f"{source}: {key}.{name}: no such strut, expected {', '.join(struts)}"
                )
    _check_observed(config, struts, heights, source)
    status = config.status
    if "status" not in config.model_fields_set:
        status = _all_in("RIG_STATUS", STATUS, database) or None
    observers = {name: config.observers.get(name, PiObserver()) for name in struts}
    height = {name: heights[name] for name in struts if name in heights}
    return config.model_copy(
        update={
            "signals": config.signals.model_copy(update={"height": height}),
            "observers": observers,
            "publish": {name: publish[name] for name in struts if name in publish},
            "status": status,
        }
    )


def _check_observed(
    config: RunConfig, struts: list[str], heights: Mapping[str, HeightSignal], source: Path
) -> None:
    """Refuse an observer without a height, a height without one, and sensors that nobody uses."""
    for name in struts:
        unobserved = isinstance(config.observers.get(name), NoObserver)
        if name not in heights and not unobserved:
            raise InputError(
                f"{source}: signals.height.{name}: is missing, expected its signal, or observers."
                f"{name}: {{kind: none}} for a strut that nobody measures"
            )
        if name in heights and unobserved:
            raise InputError(
                f"{source}: observers.{name}.kind: none takes no height, expected "
                f"signals.height.{name} to be left out"
            )
    seen = [(entry.message, entry.signal) for entry in config.signals.height.values()]
    for name, strut, entry in config.signals.sensors():
        if (entry.message, entry.signal) in seen:
            raise InputError(
                f"{source}: signals.further.{name}: {entry.message}.{entry.signal} is a height or "
                "a further sensor already, expected another signal"
            )
        seen.append((entry.message, entry.signal))
        own_s = heights[strut].delay_s if strut in heights else 0.0
        if abs(entry.delay_s - own_s) > _MOST_APART_S:
            raise InputError(
                f"{source}: signals.further.{name}.delay_s: {entry.delay_s:g}: expected at most "
                f"{_MOST_APART_S:g} s more or less than that of the height ({own_s:g})"
            )
    for name in config.signals.further:
        if not isinstance(config.observers.get(name), KalmanObserver):
            raise InputError(
                f"{source}: signals.further.{name}: expected observers.{name}.kind kalman, "
                "because the others use the height alone"
            )


_Entry = TypeVar("_Entry")


def _named(given: Mapping[str, _Entry], struts: list[str], place: str) -> Mapping[str, _Entry]:
    """Entries by strut name, where a model of one strut may leave the name out."""
    if list(given) != [""]:
        return given
    if len(struts) > 1:
        raise InputError(
            f"{place}: the model has {len(struts)} struts, expected one entry for each of "
            f"{', '.join(struts)}"
        )
    return {struts[0]: given[""]}


def _default_messages(
    struts: list[str], database: Database, config: RunConfig
) -> dict[str, Mapped]:
    found: dict[str, Mapped] = {}
    for index, name in enumerate(struts):
        ending = "" if index == 0 else f"_{index + 1}"
        estimate = _all_in(f"RIG_ESTIMATE{ending}", ESTIMATE, database)
        kinematics = _all_in(f"RIG_KINEMATICS{ending}", KINEMATICS, database)
        found[name] = {**estimate, **kinematics}
        if isinstance(config.observers.get(name), KalmanObserver):
            found[name] |= _all_in(f"RIG_UNCERTAINTY{ending}", UNCERTAINTY, database)
    return found


def _all_in(message: str, publications: Iterable[Publication], database: Database) -> Mapped:
    """The publications that a message has a signal of that name for, if the DBC has it."""
    if message not in database.messages:
        return {}
    signals = database.messages[message].signals
    return {
        item.key: SignalName(message=message, signal=item.signal)
        for item in publications
        if item.signal in signals
    }


def _check_messages(config: RunConfig, database: Database, source: Path) -> None:
    outputs = config.published_messages()
    for key, entry in config.subscribed().items():
        _check_signal(database, entry, f"{source}: {key}")
        if entry.message in outputs:
            raise InputError(
                f"{source}: {key}: {entry.message} is also published, "
                "expected a message of the bench"
            )
    published = config.published()
    entries = list(published.values())
    for key, entry in published.items():
        _check_signal(database, entry, f"{source}: {key}")
        if entries.count(entry) > 1:
            raise InputError(
                f"{source}: {key}: signal {entry.signal} of {entry.message} stands twice, "
                "expected once"
            )
    if config.authentication is not None:
        names = {entry.message for entry in config.subscribed().values()}.union(outputs)
        _check_authentication(
            config,
            config.authentication,
            [database.message(name) for name in sorted(names)],
            source,
        )


def _check_devices(config: RunConfig, database: Database, source: Path) -> None:
    """Refuse devices that send nothing that is used, and ids that mean something else already."""
    read = {entry.message for entry in config.subscribed().values()}
    messages = [database.message(name) for name in (*read, *config.published_messages())]
    taken = {
        message.arbitration_id: message.name for message in messages if not message.is_extended
    }
    senders = sorted({found for name in read if (found := database.message(name).sender)})
    for name, entry in config.devices.items():
        place = f"{source}: devices.{name}"
        if config.authentication is not None:
            raise InputError(f"{place}: expected none beside authentication, which it cannot do")
        if name not in senders:
            raise InputError(
                f"{place}: sends none of the signals in {database.path.name}, expected the name of "
                f"a node that does: {', '.join(senders) or 'the DBC names none'}"
            )
        _check_kind(config, database, name, place)
        ids = entry.device(name, is_vital=False).ids
        if len(set(ids)) < len(ids):
            raise InputError(f"{place}.emergency_id: {ids[0]:#x} is the id of its heartbeats")
        for arbitration_id in ids:
            other = taken.setdefault(arbitration_id, f"devices.{name}")
            if other != f"devices.{name}":
                raise InputError(
                    f"{place}: {arbitration_id:#x} is an id of {other} already, expected another "
                    "node_id or emergency_id"
                )
        for number, alarm in enumerate(entry.alarms):
            message = database.message(alarm.message)
            signal = message.signal(alarm.signal)
            if message.sender != name or signal.is_float or signal.scale != 1 or signal.offset:
                raise InputError(
                    f"{place}.alarms.{number}: {alarm.message}.{alarm.signal}: expected an integer "
                    f"without scale and offset that {name} sends"
                )


def _check_kind(config: RunConfig, database: Database, name: str, place: str) -> None:
    """Refuse a NAME of J1939 for a device that sends anything else, and an alarm named twice."""
    entry = config.devices[name]
    read = {item.message for item in config.subscribed().values()}
    own = [database.message(item) for item in sorted(read) if database.message(item).sender == name]
    other = next((item.name for item in own if not item.is_j1939), None)
    if entry.j1939_name is not None and other is not None:
        raise InputError(f"{place}.j1939_name: {other} is no message of J1939 in the DBC")
    if any(entry.alarms.count(alarm) > 1 for alarm in entry.alarms):
        raise InputError(f"{place}.alarms: a signal stands twice, expected it once")


def _check_signal(database: Database, entry: SignalName, key: str) -> None:
    try:
        database.message(entry.message).signal(entry.signal)
    except DatabaseError as error:
        raise InputError(f"{key}: {error}") from error


def _check_authentication(
    config: RunConfig, asked: AuthenticationConfig, messages: list[Message], source: Path
) -> None:
    if config.bus.data_bitrate is None:
        raise InputError(
            f"{source}: authentication: classic CAN has no room for it, expected bus.data_bitrate"
        )
    for message in messages:
        if message.is_extended:
            raise InputError(
                f"{source}: authentication: {message.name} has a 29-bit id, expected 11 bits, "
                "because SecOC's data ids have 16"
            )
        length = message.length_bytes + asked.trailer_bytes
        if length not in FD_LENGTHS:
            raise InputError(
                f"{source}: authentication: {message.name} would be {length} bytes long, "
                f"expected one of CAN FD's lengths {', '.join(map(str, FD_LENGTHS))}"
            )
