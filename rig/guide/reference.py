"""Parts of the guide that the code knows, as Markdown: effects, keys, quantities, commands."""

import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from can_dbc.units import Dimension
from dart_model.effects import CATALOGUE, FAMILY_WORDS, Effect, Motion
from dart_model.effects.calling import force_over_arrays, rates_over_arrays
from dart_model.effects.law import Force, Rate
from dart_model.spec import ModelSpec
from dart_model.virtual_sensors import KINDS
from rig.bridge.published_quantities import STATUS, STRUT, TIMING
from rig.bridge.values import Mode
from rig.channels.measured_quantities import BENCH_QUANTITIES, HEIGHT
from rig.diagnosis.search.criteria import CRITERIA, SelectionCriteria
from rig.files.pictures import Figure
from rig.formats.mapping import TableMapping
from rig.guide.site import Block
from rig.observers import OBSERVERS
from rig.plan.config import KeyName, OneOf, RunConfig
from rig.simulated_bench.effects import EFFECT_KINDS, EffectParameter
from rig.simulated_bench.schema import BenchConfig

Array = NDArray[np.float64]

_FIELDS = "__pydantic_fields__"
"""Attribute of a configuration's section, with its keys."""

_THIN = 10
"""Every how many steps of the integration a picture has a point."""

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


_MOST_PARAMETERS = 12
"""Rows of an effect's table: the table of forces has dozens of parameters alike."""


def generated_blocks(
    commands: Callable[[], str], exit_codes: Mapping[int, str]
) -> dict[str, Block]:
    """Generated parts of the guide, by the names that stand in its pages.

    Args:
        commands: Markdown of every command.
        exit_codes: Meanings of the commands' exit codes.
    """
    texts: dict[str, Callable[[], str]] = {
        "commands": commands,
        "exit-codes": lambda: _table(
            ("Exit code", "Meaning"), [(f"`{code}`", text) for code, text in exit_codes.items()]
        ),
        "configuration-keys": lambda: _keys(RunConfig),
        "observer-keys": _observer_keys,
        "model-keys": lambda: _keys(ModelSpec),
        "mapping-keys": lambda: _keys(TableMapping),
        "bench-keys": lambda: _keys(BenchConfig),
        "bench-effects": _bench_effects,
        "measured-quantities": _measured_quantities,
        "published-quantities": _published_quantities,
        "virtual-sensors": _virtual_sensors,
        "effect-families": _families,
        "criteria": _criteria,
        "modes": lambda: _table(
            ("Mode", "Number on the bus"), [(mode.name, str(mode.value)) for mode in Mode]
        ),
    }
    blocks: dict[str, Block] = {name: _without_pictures(text) for name, text in texts.items()}
    return {**blocks, "effects": _effects}


def _without_pictures(text: Callable[[], str]) -> Block:
    return lambda _: text()


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _keys(model: type[object]) -> str:
    rows = [(f"`{key}`", default, meaning) for key, default, meaning in _rows(model)]
    return _table(("Key", "Default", "Meaning"), rows)


def _observer_keys() -> str:
    parts = [f"### Kind `{kind}`\n\n{_keys(observer)}" for kind, observer in OBSERVERS.items()]
    return "\n\n".join(parts)


def _criteria() -> str:
    """Thresholds of a diagnosis, with their values, as their docstring explains them."""
    text = inspect.getdoc(SelectionCriteria) or ""
    entries = re.split(r"^    (\w+): ", text.partition("Attributes:\n")[2], flags=re.MULTILINE)[1:]
    rows = [
        (f"`{name}`", f"{getattr(CRITERIA, name):g}", " ".join(meaning.split()))
        for name, meaning in zip(entries[::2], entries[1::2], strict=True)
    ]
    return _table(("Threshold", "Value", "Meaning"), rows)


def _bench_effects() -> str:
    rows = [
        (f"`{name}`", kind.words, ", ".join(map(_bench_parameter, kind.parameters)))
        for name, kind in EFFECT_KINDS.items()
    ]
    return _table(("Effect", "Meaning", "Parameters (default)"), rows)


def _bench_parameter(item: EffectParameter) -> str:
    default = "" if item.default is None else f" ({item.default:g})"
    return f"`{item.name}`{default}"


def _measured_quantities() -> str:
    rows = [
        (f"`{item.key}`", _unit(item.dimension), f"`{prefix}{item.column}`", item.words)
        for prefix, items in (("STRUT.measured_", (HEIGHT,)), ("", BENCH_QUANTITIES))
        for item in items
    ]
    return _table(("Key under `signals`", "Unit", "Column of the log", "Meaning"), rows)


def _published_quantities() -> str:
    rows = [
        (f"`{group}`", f"`{item.key}`", _unit(item.dimension), f"`{item.signal}`", item.meaning)
        for group, items in (("publish", STRUT), ("status", STATUS), ("timing", TIMING))
        for item in items
    ]
    return _table(("Under", "Key", "Unit", "Default signal", "Meaning"), rows)


def _virtual_sensors() -> str:
    rows = [
        (f"`{key}`", f"a {it.of}", _unit(it.dimension), it.meaning) for key, it in KINDS.items()
    ]
    return _table(("Key", "Value", "Unit", "Reading"), rows)


_UNITS = {Dimension.NUMBER: "-", Dimension.TEMPERATURE: "°C", Dimension.ACCELERATION: "m/s²"}
"""Units that a DBC spells in another way than a text."""


def _unit(dimension: Dimension) -> str:
    return _UNITS.get(dimension, dimension.value)


def _families() -> str:
    rows = [
        (f"`{family}`", words, ", ".join(f"`{it.name}`" for it in _of_family(family)) or "-")
        for family, words in FAMILY_WORDS.items()
    ]
    return _table(("Family", "Meaning", "Effects"), rows)


def _of_family(family: str) -> list[Effect]:
    return [item for item in CATALOGUE.values() if item.family == family]


def _effects(pictures: Path | None) -> str:
    """Every effect: parameters, formula, literature, and its force along a harmonic motion."""
    parts: list[str] = []
    for family, words in FAMILY_WORDS.items():
        effects = _of_family(family)
        if effects:
            parts.append(f"## {words[0].upper()}{words[1:]} (`{family}`)")
            parts += [_effect(item, pictures) for item in effects]
    return "\n\n".join(parts)


_UNBOUNDED = 1e4
"""Magnitude from which on a bound only keeps numbers finite."""

_LEAST_POSITIVE = 1e-9
"""Up to it, a lower bound only keeps a parameter above zero."""


def range_text(low: float, high: float) -> str:
    """The range of a parameter in words, without bounds that only keep numbers finite."""
    if high < _UNBOUNDED:
        return f"{low:g} to {high:g}"
    if low <= -_UNBOUNDED:
        return "any"
    return "above 0" if 0.0 < low <= _LEAST_POSITIVE else f"{low:g} or more"


def _effect(item: Effect, pictures: Path | None) -> str:
    rows = [
        (f"`{it.name}`", it.unit or "-", range_text(it.low, it.high), it.meaning)
        for it in item.parameters[:_MOST_PARAMETERS]
    ]
    more = len(item.parameters) - _MOST_PARAMETERS
    names = ", ".join(f"`{name}`" for name in item.simpler)
    simpler = f" If a simpler law ({names}) fits as well, a diagnosis names that law instead."
    simpler *= bool(item.simpler)
    beyond = " in addition to the inertia and the weight of the mass" if item.adds_mass else ""
    parts = [
        f"### {item.name}",
        f"{item.words[0].upper()}{item.words[1:]}.{simpler} Required excitation: "
        f"{item.excitation}.",
        _table(("Parameter", "Unit", "Bounds", "Meaning"), rows),
        *([f"The {more} other parameters are of the same kind."] if more > 0 else []),
        f"Force{beyond}, N:\n\n```python\n{_formula('force_n', item.force)}\n```",
    ]
    if item.rate:
        parts.append(
            "Time derivatives of its internal states:\n\n```python\n"
            + _formula("rate", item.rate)
            + "\n```"
        )
    if pictures is not None and _draw(item, pictures / f"{item.name}.svg"):
        parts.append(
            f"![Force of {item.name} over height and over velocity](../generated/{item.name}.svg)"
        )
    parts.append(f"Reference: {item.reference}")
    return "\n\n".join(parts)


def _formula(name: str, law: Force | Rate) -> str:
    """A law as it is written, over the names of what it reads, with its constants."""
    source = inspect.getsource(law)
    body = source[source.index("->") :].partition(":\n")[2].rstrip()
    names = ", ".join(inspect.signature(law).parameters)
    head = textwrap.fill(f"{name}({names}):", 100, subsequent_indent=" " * (len(name) + 1))
    function = cast("types.FunctionType", law)
    values = {item: function.__globals__.get(item) for item in function.__code__.co_names}
    constants = [f"\n    # {k} = {v:g}" for k, v in values.items() if isinstance(v, int | float)]
    return f"{head}\n{body}{''.join(constants)}"


def _draw(item: Effect, path: Path) -> bool:
    """Draw an effect's force along a harmonic motion; False if a search has no start for it."""
    starts = item.starts(_MOTION)
    if not starts:
        return False
    height, velocity, force = _loop(item, list(starts[0]))
    figure: Any = Figure(figsize=(8, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(height[::_THIN] * 1e3, force[::_THIN], color="tab:blue")
    left.set(xlabel="height / mm", ylabel="force / N")
    right.plot(velocity[::_THIN], force[::_THIN], color="tab:blue")
    right.set(xlabel="velocity / (m/s)")
    for panel in (left, right):
        panel.grid(alpha=0.3)
    figure.savefig(path, format="svg")
    return True


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
    """Key, default and meaning of every key of a configuration and of its sections.

    In a key, a word in capitals stands for the keys of a mapping, and `[]` for the entries of a
    list.
    """
    meanings = _attributes(model)
    fields = cast("Mapping[str, FieldInfo]", getattr(model, _FIELDS))
    refused = getattr(model, "refused_keys", frozenset[str]())
    keys = [
        (name, field.annotation, field.get_default(call_default_factory=True))
        for name, field in fields.items()
        if not getattr(field, "exclude", False) and name not in refused
    ]
    extra = inspect.get_annotations(model).get("__pydantic_extra__")
    if extra is not None:
        word, value = typing.get_args(extra)
        keys.append((_word(word), value, None))
    for name, annotation, default in keys:
        meaning = meanings.get(name, "")
        sections = _sections(annotation)
        if sections:
            at, first = sections[0]
            words = (inspect.getdoc(first) or "").partition("\n")[0]
            yield f"{prefix}{name}", _section_default(default), meaning or words
            yield from _alternatives([item for _, item in sections], f"{prefix}{name}{at}.")
        else:
            text = "required" if default is PydanticUndefined else _default_text(default)
            yield f"{prefix}{name}", text, meaning


def _section_default(default: object) -> str:
    """Text of a section's default; empty if its keys have defaults of their own."""
    if default is PydanticUndefined:
        return "required"
    return "none" if default is None or default in ((), {}) else ""


def _alternatives(sections: Sequence[type[object]], prefix: str) -> Iterator[tuple[str, str, str]]:
    """One row for each key of alternative sections, with each of its meanings.

    A key that only some of them have, or require, is followed by the choice that these are;
    without such a choice, it is not required.
    """
    by_key: dict[str, list[tuple[type[object], str, str]]] = {}
    for section in sections:
        for key, default, meaning in _rows(section, prefix):
            by_key.setdefault(key, []).append((section, default, meaning))
    for key, same in by_key.items():
        default, meaning = same[0][1], _joined_meaning(key, same)
        requiring = [section for section, text, _ in same if text == "required"]
        if 0 < len(requiring) < len(same) and not _is_choice(key, same[0][0]):
            default = next(text for _, text, _ in same if text != "required")
            meaning += f" Required with {_choice(requiring)}."
        if len(same) < len(sections) and "." not in key.removeprefix(prefix):
            choice = _choice([section for section, *_ in same])
            meaning += choice and f" Only with {choice}."
            default = "" if default == "required" and not choice else default
        yield key, default, meaning


def _joined_meaning(key: str, same: Sequence[tuple[type[object], str, str]]) -> str:
    """Meaning of a key of alternative sections: one text, or one for each choice."""
    having: dict[str, list[type[object]]] = {}
    for section, _, text in same:
        having.setdefault(text, []).append(section)
    if len(having) == 1 or _is_choice(key, same[0][0]):
        return " ".join(having)
    return " ".join(f"With {_choice(those)}: {text}" for text, those in having.items())


def _is_choice(key: str, section: type[object]) -> bool:
    """Whether a key of alternative sections is the one that selects the section."""
    return _choice([section]).startswith(f"`{key.rpartition('.')[2]}: ")


def _choice(sections: Sequence[type[object]]) -> str:
    """Keys with the only value that each section permits, such as `kind: sine`; empty if none."""
    values = [
        f"`{name}: {typing.get_args(field.annotation)[0]}`"
        for section in sections
        for name, field in cast("Mapping[str, FieldInfo]", getattr(section, _FIELDS)).items()
        if typing.get_origin(field.annotation) is typing.Literal
        and len(typing.get_args(field.annotation)) == 1
    ]
    return " or ".join(values)


def _default_text(default: object) -> str:
    """A default as YAML, in code; none for a key that is absent."""
    if default is None or default in ((), {}):
        return "none"
    text = _yaml(default)
    return text and f"`{text}`"


def _yaml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, cast('tuple[object, ...]', value)))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, str | int | float) else ""


def _sections(annotation: object, at: str = "") -> list[tuple[str, type[object]]]:
    """Sections that a key may hold, also in unions, tuples and mappings.

    Each is preceded by what follows the key: `.STRUT` for a mapping, `[]` for a list.
    """
    if isinstance(annotation, type) and hasattr(annotation, _FIELDS):
        return [(at, annotation)]
    kinds = [item for item in getattr(annotation, "__metadata__", ()) if isinstance(item, OneOf)]
    if kinds:
        return [(at, section) for section in kinds[0].choices.values()]
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is dict:
        name, value = parts
        return _sections(value, f"{at}.{_word(name)}")
    if origin in (typing.Union, types.UnionType, tuple, typing.Annotated):
        at += "[]" if origin is tuple else ""
        return [section for part in parts for section in _sections(part, at)]
    return []


def _word(name: object) -> str:
    """The word that stands for the keys of a mapping."""
    metadata = getattr(name, "__metadata__", ())
    return next((item.word for item in metadata if isinstance(item, KeyName)), "NAME")


def _attributes(model: type[object]) -> dict[str, str]:
    """Meanings of the keys: sections "Attributes" in the docstrings of a class and its bases."""
    meanings: dict[str, str] = {}
    for base in reversed(model.__mro__):
        section = (inspect.getdoc(base) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
        for name, text in re.findall(r"^ {4}(\w+):(.*(?:\n {5,}.*)*)", section, re.MULTILINE):
            meanings[name] = " ".join(text.split())
    return meanings
