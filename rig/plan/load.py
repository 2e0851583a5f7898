"""Plans read from files: of a configuration, and of a run."""

from dataclasses import replace
from pathlib import Path

from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.errors import InputError
from can_dbc.yaml_file import load_yaml, validate
from dart_model.spec import ModelSpec, load_model, load_named_model
from rig.files.file_kinds import FILE_KINDS
from rig.log.file_names import DBC_FILE, MODEL_FILE, RUN_FILE
from rig.log.reader import RunHeader, read_header
from rig.plan.config import RunConfig
from rig.plan.plan import Plan, resolve


def load_plan(path: Path, *, model: str | None = None, duration_s: float | None = None) -> Plan:
    """The plan of a configuration, with all files that it names, which are in its folder.

    A file or name of a model, and a length, may replace the configuration's.

    Raises:
        InputError: One line that names file, key, value and what was expected.
        DatabaseError: The same, of the DBC.
    """
    config = load_yaml(RunConfig, path, kinds=FILE_KINDS)
    if duration_s is not None:
        if not 0.0 < duration_s < float("inf"):
            raise InputError(f"--duration-s {duration_s}: expected a finite number above zero")
        config = config.model_copy(update={"duration_s": duration_s})
    if model is None:
        spec = load_named_model(config.model, path.parent, path)
    else:
        spec = load_named_model(model, Path())
    database = load_database(DEFAULT_DATABASE if config.dbc is None else path.parent / config.dbc)
    plan = resolve(config, path, spec, database)
    settings = config.authentication
    if settings is None:
        return plan
    return replace(plan, authentication=settings.load(path))


def plan_of_run(folder: Path, model: ModelSpec | None = None) -> Plan:
    """The plan that a run follows, or followed, from the files in its folder; without its key.

    Another model may replace the run's.

    Raises:
        InputError: A file of the run is missing or damaged.
        DatabaseError: Its DBC is.
    """
    return plan_of_header(folder, read_header(folder), model)


def plan_of_header(folder: Path, header: RunHeader, model: ModelSpec | None = None) -> Plan:
    """The plan of a run whose header has been read, as of `plan_of_run`.

    Raises:
        InputError: Another file of the run is missing or damaged.
        DatabaseError: Its DBC is.
    """
    source = folder / RUN_FILE
    config = validate(RunConfig, header.get("config"), f"{source}: config")
    spec = load_model(folder / MODEL_FILE) if model is None else model
    return resolve(config, source, spec, load_database(folder / DBC_FILE))
