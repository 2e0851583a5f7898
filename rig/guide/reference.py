"""The reference, generated from the code: effects, keys of a configuration, commands."""

import base64
import inspect
import io
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE, FAMILY_WORDS, Effect, Motion
from dart_model.effects.calling import force_over_arrays, rates_over_arrays
from dart_model.effects.law import Force, Rate
from dart_model.spec import ModelSpec
from rig.bridge.published_quantities import STATUS, STRUT, TIMING
from rig.channels.measured_quantities import BENCH_QUANTITIES, HEIGHT
from rig.files.pictures import Figure
from rig.observers import OBSERVERS
from rig.pages.html import render
from rig.plan.config import OneOf, RunConfig
from rig.simulated_bench.effects import EFFECT_KINDS
from rig.simulated_bench.schema import BenchConfig

Array = NDArray[np.float64]

_FIELDS = "__pydantic_fields__"
"""Attribute of a configuration's section, with its keys."""

_MOTION = Motion(
    low_m=0.35,
    high_m=0.45,
    speed_m_per_s=0.25,
    top_speed_m_per_s=0.6,
    least_stroke_m=0.1,
    duration_s=20.0,
    step_s=1e-3,
    free_length_m=0.5,
    stiffness_n_per_m=500.0,
    damping_n_s_per_m=100.0,
    mass_kg=10.0,
    force_n=50.0,
    temperatures_c=(20.0, 80.0),
    tones=((3.0, 0.0),),
)
"""Motion along which each effect is drawn, with the initial parameters of a search."""


def write_reference(folder: Path, commands: Mapping[str, str]) -> Path:
    """Write the reference as `index.html`, with the help text of each command; returns the file.

    Raises:
        InputError: The folder cannot be written, or holds a reference.
    """
    path = folder / "index.html"
    if path.exists():
        raise InputError(f"{path}: exists, expected a folder without it")
    try:
        # Before the work of some seconds.
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    text = render(
        "reference/page.html",
        families={
            words: [item for item in CATALOGUE.values() if item.family == family]
            for family, words in FAMILY_WORDS.items()
        },
        formula=_formula,
        picture_of=_picture,
        keys_of=_rows,
        bridge=RunConfig,
        observers=OBSERVERS,
        measured=[
            (q.key, q.dimension.value, q.column, q.words) for q in (HEIGHT, *BENCH_QUANTITIES)
        ],
        published=[
            (group, item.key, item.dimension.value, item.signal)
            for group, items in (("publish", STRUT), ("status", STATUS), ("timing", TIMING))
            for item in items
        ],
        model=ModelSpec,
        bench=BenchConfig,
        bench_effects=[
            (name, ", ".join(parameter.name for parameter in kind.parameters))
            for name, kind in EFFECT_KINDS.items()
        ],
        commands=commands,
    )
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def _formula(name: str, law: Force | Rate) -> str:
    """A law as it is written, over the names of what it reads."""
    source = inspect.getsource(law)
    body = source[source.index("->") :].partition(":\n")[2].rstrip()
    names = ", ".join(inspect.signature(law).parameters)
    head = textwrap.fill(f"{name}({names}):", 100, subsequent_indent=" " * (len(name) + 1))
    return f"{head}\n{body}"


def _picture(item: Effect) -> str:
    """Force of an effect along a harmonic motion, a PNG in base64; empty if it has no start."""
    starts = item.starts(_MOTION)
    if not starts:
        return ""
    height, velocity, force = _loop(item, list(starts[0]))
    figure: Any = Figure(figsize=(8, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(height * 1e3, force, color="tab:blue")
    left.set(xlabel="height / mm", ylabel="force / N")
    right.plot(velocity, force, color="tab:blue")
    right.set(xlabel="velocity / (m/s)")
    for panel in (left, right):
        panel.grid(alpha=0.3)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=80)
    return base64.b64encode(file.getvalue()).decode("ascii")


def _loop(item: Effect, parameters: list[float]) -> tuple[Array, Array, Array]:
    """Height, velocity and force of the second of two periods."""
    motion, omega = _MOTION, 2.0 * np.pi * 2.4
    t_s = np.linspace(0.0, 4.0 * np.pi / omega, 8001)
    height = 0.5 * (motion.low_m + motion.high_m) + 0.5 * motion.stroke_m * np.sin(omega * t_s)
    velocity = 0.5 * motion.stroke_m * omega * np.cos(omega * t_s)
    strut = (
        motion.free_length_m,
        motion.stiffness_n_per_m,
        motion.damping_n_s_per_m,
        9.81,
    )
    force_n, write_rates = force_over_arrays(item), rates_over_arrays(item)
    step, force = float(t_s[1]), np.empty(len(t_s))
    state: list[float] = [0.0] * item.state_size
    for k in range(len(t_s)):
        given = (float(t_s[k]), float(height[k]), float(velocity[k]), 50.0, 60.0, state)
        force[k] = force_n(*given, parameters, strut)
        if state:
            rates: list[float] = [0.0] * item.state_size
            write_rates(*given, parameters, strut, rates)
            state = [x + step * rate for x, rate in zip(state, rates, strict=True)]
    half = len(t_s) // 2
    return height[half:], velocity[half:], force[half:]


def _rows(model: type[object], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Key, default and meaning of every key of a configuration and of its sections."""
    meanings = _attributes(model)
    fields = cast("Mapping[str, FieldInfo]", getattr(model, _FIELDS))
    for name, field in fields.items():
        if getattr(field, "exclude", False):
            continue
        default = field.get_default(call_default_factory=True)
        sections = _sections(field.annotation)
        meaning = meanings.get(name, "")
        if sections:
            first = (inspect.getdoc(sections[0]) or "").partition("\n")[0]
            yield f"{prefix}{name}", "", meaning or first
            rows = [row for section in sections for row in _rows(section, f"{prefix}{name}.")]
            yield from {row[0]: row for row in rows}.values()
        else:
            text = "required" if default is PydanticUndefined else _default_text(default)
            yield f"{prefix}{name}", text, meaning


def _default_text(default: object) -> str:
    if default is None:
        return "none"
    return str(default) if isinstance(default, str | int | float | bool) else ""


def _sections(annotation: object) -> list[type[object]]:
    """Sections that a key may hold, also in unions, tuples and mappings."""
    if isinstance(annotation, type) and hasattr(annotation, _FIELDS):
        return [annotation]
    kinds = [item for item in getattr(annotation, "__metadata__", ()) if isinstance(item, OneOf)]
    if kinds:
        return list(kinds[0].choices.values())
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, types.UnionType, tuple, dict, typing.Annotated):
        return [section for part in typing.get_args(annotation) for section in _sections(part)]
    return []


def _attributes(model: type[object]) -> dict[str, str]:
    """Meanings of the keys: sections "Attributes" in the docstrings of a class and its bases."""
    meanings: dict[str, str] = {}
    for base in reversed(model.__mro__):
        section = (inspect.getdoc(base) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
        for name, text in re.findall(r"^ {4}(\w+):(.*(?:\n {5,}.*)*)", section, re.MULTILINE):
            meanings[name] = " ".join(text.split())
    return meanings
