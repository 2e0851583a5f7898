"""Reads the channels of an MF4 file at the height's times."""

import importlib
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from can_dbc.errors import InputError, missing_package
from rig.formats.mapping import OutputColumn, TableMapping
from rig.formats.text_table import Array, Columns


def read_mf4_channels(
    source: Path, mapping: TableMapping, outputs: Sequence[OutputColumn]
) -> Columns:
    """Times and readings of the channels of an MF4 file, at the height's times.

    Raises:
        InputError: The package asammdf is missing, the file is damaged, or a channel is not there.
    """
    del mapping  # The channels have times of their own.
    try:
        asammdf = importlib.import_module("asammdf")  # optional, and slow to import
        damaged = cast("type[Exception]", asammdf.blocks.utils.MdfException)
    except ImportError as error:
        raise InputError(
            f"{source}: " + missing_package("asammdf", "pip install -e '.[mf4]'")
        ) from error
    try:
        with source.open("rb") as raw, asammdf.MDF(raw) as file:
            signals = [_read_channel(source, file, output) for output in outputs]
    except InputError:
        raise
    except (damaged, OSError, ValueError, LookupError, AttributeError, struct.error) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{source}: is no such MF4 file, or is damaged: {reason}") from error
    at_s = signals[0][0]
    t_s = at_s - at_s[0]
    assumptions = [f"t_s from the times of channel {outputs[0].column!r}, 0 at {at_s[0]:.9g} s"]
    values = [signals[0][1]]
    for output, (own_s, readings) in zip(outputs[1:], signals[1:], strict=True):
        values.append(np.interp(at_s, own_s, readings))
        if not np.array_equal(own_s, at_s):
            assumptions.append(f"{output.name}: {len(own_s)} samples, linear between them")
    return t_s, values, assumptions


def _read_channel(source: Path, file: Any, output: OutputColumn) -> tuple[Array, Array]:
    name = output.column
    if not isinstance(name, str):
        raise InputError(f"{source}: {output.key}.column = {name}: expected the name of a channel")
    entries = cast("tuple[tuple[int, int], ...]", file.channels_db.get(name, ()))
    if len(entries) != 1:
        wrong = f"there {len(entries)} times" if entries else "not there"
        raise InputError(
            f"{source}: {output.key}.column = {name!r} is {wrong}, expected one channel"
        )
    group, index = entries[0]
    signal = file.get(group=group, index=index)
    values = np.array(signal.samples, dtype=np.float64)
    t_s = np.array(signal.timestamps, dtype=np.float64)
    if len(values) < 2 or values.ndim != 1 or not np.all(np.isfinite(values)):
        raise InputError(f"{source}: channel {name!r}: expected two or more numbers")
    if not output.has_gain and signal.unit and signal.unit != output.unit:
        raise InputError(
            f"{source}: {output.key}.unit = {output.unit!r}, but the file has {signal.unit!r}"
        )
    return t_s, values
