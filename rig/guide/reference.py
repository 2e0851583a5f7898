"""The reference, generated from the code: effects, keys of a configuration, commands."""

import base64
import inspect
import io
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE, FAMILY_WORDS, Effect, Motion
from dart_model.effects.calling import force_over_arrays, rates_over_arrays
from dart_model.effects.law import Force, Rate
from dart_model.spec import ModelSpec
from rig.bridge.publications import STATUS, STRUT, TIMING
from rig.channels.quantities import BENCH_QUANTITIES, HEIGHT
from rig.observers import OBSERVERS
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

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;
color:#1c1e21;background:#fff}
h1,h2,h3{line-height:1.2}h2{margin-top:3rem;border-bottom:2px solid #d5d9e0}
h3{margin:2.2rem 0 .4rem;font-family:ui-monospace,monospace}
table{border-collapse:collapse;margin:.6rem 0;width:100%}
td,th{border-bottom:1px solid #e3e6ea;padding:.25rem .6rem;text-align:left;vertical-align:top}
code,pre{font-family:ui-monospace,monospace;font-size:.9em}pre{background:#f4f6f8;padding:.7rem;
overflow-x:auto}img{max-width:100%}nav a{margin-right:1rem}.unit{color:#5b6470}
@media(prefers-color-scheme:dark){body{color:#e4e6ea;background:#16181c}pre{background:#22262c}
td,th{border-color:#333940}h2{border-color:#3a4048}img{background:#fff}}
"""


def write_reference(folder: Path, commands: Mapping[str, str]) -> Path:
    """Write the reference as one page; returns the file.

    Args:
        folder: Where to write `index.html`.
        commands: Help text of each command, by its name.

    Raises:
        InputError: The folder cannot be written, or holds a reference.
    """
    path = folder / "index.html"
    if path.exists():
        raise InputError(f"{path}: exists, expected a folder without it")
    text = _page(commands)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def _page(commands: Mapping[str, str]) -> str:
    parts = [
        "<h1>rig: reference</h1><p>Made from the code by <code>rig docs</code>. SI everywhere; "
        "every strut force is positive when it pushes its two bodies apart.</p>",
        '<nav><a href="#effects">Effects</a><a href="#configuration">Configuration</a>'
        '<a href="#bus">What is measured and published</a><a href="#model">Model file</a>'
        '<a href="#bench">Simulated bench</a><a href="#commands">Commands</a></nav>',
        '<h2 id="effects">Effects</h2><p>Each is drawn at the parameters with which a search '
        "begins, over a stroke of 100 mm at 2.4 Hz: force over height, and over velocity.</p>",
    ]
    for family, words in FAMILY_WORDS.items():
        effects = [item for item in CATALOGUE.values() if item.family == family]
        if effects:
            parts.append(f"<h2>{escape(family)}: {escape(words)}</h2>")
            parts += map(_effect, effects)
    parts.append('<h2 id="configuration">Configuration of the bridge</h2>')
    parts.append(_keys(RunConfig))
    for kind, observer in OBSERVERS.items():
        parts.append(f"<h3>observers.&lt;strut&gt; of kind {escape(kind)}</h3>")
        parts.append(_keys(observer))
    parts.append('<h2 id="bus">What is measured and published</h2>')
    parts.append(_bus())
    parts.append('<h2 id="model">Model file</h2>')
    parts.append(_keys(ModelSpec))
    parts.append('<h2 id="bench">Configuration of a simulated bench</h2>')
    parts.append(_keys(BenchConfig))
    parts.append("<p>Undeclared effects, which share no code with those of a model:</p>")
    parts.append(_table(("name", "parameters"), _bench_effects()))
    parts.append('<h2 id="commands">Commands</h2>')
    for name, text in commands.items():
        parts.append(f"<h3>rig {escape(name)}</h3><pre>{escape(text)}</pre>")
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>rig: reference</title>'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<style>{_STYLE}</style>{''.join(parts)}</html>"
    )


def _effect(item: Effect) -> str:
    parameters = [
        (p.name, p.unit or "-", f"{p.low:g} to {p.high:g}", p.meaning) for p in item.parameters
    ]
    shown = parameters[:12]
    rest = f"<p>and {len(parameters) - 12} more</p>" if len(parameters) > 12 else ""
    rate = ""
    if item.rate is not None:
        formula = _formula("rate", item.rate)
        rate = f"<p>Rate of its internal states:</p><pre>{escape(formula)}</pre>"
    simpler = f" Degenerates to {', '.join(item.simpler)}." if item.simpler else ""
    return (
        f'<h3 id="{item.name}">{item.name}</h3><p>{escape(item.words)}.{escape(simpler)} '
        f"Seen with: {escape(item.excitation)}.</p>"
        f"{_table(('parameter', 'unit', 'bounds', 'meaning'), shown)}{rest}"
        f"<p>Force in N:</p><pre>{escape(_formula('force_n', item.force))}</pre>"
        f"{rate}{_picture(item)}<p>{escape(item.reference)}</p>"
    )


def _formula(name: str, law: Force | Rate) -> str:
    """A law as it is written, over the names of what it reads."""
    source = inspect.getsource(law)
    body = source[source.index("->") :].partition(":\n")[2].rstrip()
    names = ", ".join(inspect.signature(law).parameters)
    head = textwrap.fill(f"{name}({names}):", 100, subsequent_indent=" " * (len(name) + 1))
    return f"{head}\n{body}"


def _picture(item: Effect) -> str:
    """Force of an effect along a harmonic motion, as an image within the page."""
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
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return f'<img alt="force of {item.name}" src="data:image/png;base64,{data}">'


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


def _bus() -> str:
    measured = [(q.key, q.dimension.value, q.column, q.words) for q in (HEIGHT, *BENCH_QUANTITIES)]
    published = [
        (group, item.key, item.dimension.value, item.signal)
        for group, items in (("publish", STRUT), ("status", STATUS), ("timing", TIMING))
        for item in items
    ]
    return (
        _table(("key under signals", "unit", "column of the log", "meaning"), measured)
        + "<p>Units of the DBC are converted. What is published:</p>"
        + _table(("under", "key", "unit", "signal if only a message is given"), published)
    )


def _bench_effects() -> list[tuple[str, ...]]:
    return [
        (name, ", ".join(parameter.name for parameter in kind.parameters))
        for name, kind in EFFECT_KINDS.items()
    ]


def _keys(model: type[object], prefix: str = "") -> str:
    rows = list(_rows(model, prefix))
    return _table(("key", "default", "meaning"), rows)


def _rows(model: type[object], prefix: str) -> Iterator[tuple[str, str, str]]:
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


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in heads)
    body = "".join(
        "<tr><td><code>"
        + escape(first)
        + "</code></td>"
        + "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        + "</tr>"
        for first, *rest in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
