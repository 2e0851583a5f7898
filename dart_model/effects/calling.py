"""How a law is called: what its arguments name, and the form in which plant and loops call it.

A law names what it reads. The names of the motion and of the strut are the same for all laws; those
of parameters and internal states are its effect's own, and an own name hides the strut's.
"""

import ast
import functools
import inspect
import math
import textwrap
import zlib
from collections.abc import Callable, Mapping, Sequence
from types import CodeType, FunctionType
from typing import Literal, NamedTuple

from dart_model.effects.law import Effect, Floats, Force, Rate, Rates, Writable

MOTION = ("t_s", "height_m", "velocity_m_per_s", "applied_force_n", "temperature_c")
"""What a law may read of the motion, in the order in which it is given."""

STRUT = ("free_length_m", "stiffness_n_per_m", "damping_n_s_per_m", "gravity_m_per_s2")
"""What a law may read of its strut, in the order in which it is given."""

Origin = Literal["motion", "states", "strut", "parameters", "rates"]
_ORDER: tuple[Origin, ...] = ("motion", "states", "strut", "parameters", "rates")

ForceOverArrays = Callable[[float, float, float, float, float, Floats, Floats, Floats], float]
"""Force in N over the values of `MOTION`, internal states, parameters, and those of `STRUT`."""

RatesOverArrays = Callable[
    [float, float, float, float, float, Floats, Floats, Floats, Writable], None
]
"""The same arguments, then where the rates of the internal states are written."""


class ArgumentError(TypeError):
    """A law has an argument of an unknown name, or arguments in another order than `arguments`."""


class Argument(NamedTuple):
    """What an argument of a law stands for.

    Attributes:
        origin: Values among which it is found; `rates` is where the law writes.
        size: Number of values from there that form a row; None for a single one.
    """

    name: str
    origin: Origin
    first: int
    size: int | None = None


def arguments(law: Force | Rate, effect: Effect) -> tuple[Argument, ...]:
    """Arguments of the force or the rate of an effect.

    They stand in the order: motion, internal states, strut, parameters, rates.

    Raises:
        ArgumentError: One has a name that stands for nothing, or they are in another order.
    """
    known = _list_arguments(effect)
    names = list(inspect.signature(law).parameters)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ArgumentError(
            f"effect {effect.name}: argument {unknown[0]!r} of its law: expected one of "
            f"{', '.join(known)}"
        )
    found = tuple(known[name] for name in names)
    ranks = [_ORDER.index(item.origin) for item in found]
    if ranks != sorted(ranks):
        raise ArgumentError(
            f"effect {effect.name}: arguments {', '.join(names)} of its law: expected those of "
            f"{', then '.join(_ORDER)}"
        )
    return found


def _list_arguments(effect: Effect) -> Mapping[str, Argument]:
    known = {name: Argument(name, "motion", index) for index, name in enumerate(MOTION)}
    known |= {name: Argument(name, "strut", index) for index, name in enumerate(STRUT)}
    known |= _own("states", [(state.name, state.group) for state in effect.states])
    known |= _own("parameters", [(item.name, item.group) for item in effect.parameters])
    known["rates"] = Argument("rates", "rates", 0, effect.state_size)
    return known


def _own(origin: Origin, items: Sequence[tuple[str, str]]) -> Mapping[str, Argument]:
    """Arguments of an effect's own, each given by its name and its group."""
    own: dict[str, Argument] = {}
    for index, (name, group) in enumerate(items):
        if group:
            first, size = own[group][2:] if group in own else (index, 0)
            own[group] = Argument(group, origin, first, (size or 0) + 1)
        else:
            own[name] = Argument(name, origin, index)
    return own


@functools.cache
def force_over_arrays(effect: Effect) -> ForceOverArrays:
    """The force of an effect as a function of arrays, for callers that know no names."""
    tree = parse_law(effect.force, effect)
    return function_over_arrays(effect.force, effect, tree, (*MOTION, *_ARRAYS[:-1]))


@functools.cache
def rates_over_arrays(effect: Effect) -> RatesOverArrays:
    """The rates of an effect's internal states, likewise; of one without states, none."""
    law = effect.rate or no_rates
    return function_over_arrays(law, effect, parse_law(law, effect), (*MOTION, *_ARRAYS))


_ARRAYS = ("states", "parameters", "strut", "rates")


def no_rates() -> Rates:
    """The rate of an effect without internal states."""
    return ()


def parse_law(law: Force | Rate, effect: Effect) -> ast.FunctionDef:
    """The syntax tree of the force or the rate of an effect.

    Raises:
        ArgumentError: It is not a function.
    """
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(law))).body
    if not isinstance(tree, ast.FunctionDef):
        raise ArgumentError(f"effect {effect.name}: expected a function as its law")
    return tree


def function_over_arrays(
    law: Force | Rate, effect: Effect, tree: ast.FunctionDef, names: Sequence[str]
) -> FunctionType:
    """A function of arrays of some names, by a tree that has the arguments of a law.

    With `rates` among the names it writes what the tree returns there.
    """
    # The law is rewritten, not wrapped: a wrapper is a second function to compile for each law. The
    # code belongs to the law's file, so that numba keeps the machine code next to that file and
    # drops it when the file changes; the digest in the name covers all else that the code is of.
    taken = arguments(law, effect)
    read = [
        _assign(ast.Name(item.name, ast.Store()), _element(item.origin, ast.Constant(item.first)))
        for item in taken
        if item.size is None and item.origin != "motion"
    ]
    rows = {item.name: item for item in taken if item.size is not None}
    _OverArrays(rows, is_rate="rates" in names).generic_visit(tree)
    tree.args = ast.arguments([], [ast.arg(name) for name in names], None, [], [], None, [])
    tree.body, tree.returns = [*read, *tree.body], None
    ast.fix_missing_locations(tree)
    tree.name = f"{law.__name__}_{zlib.crc32(ast.unparse(tree).encode()):08x}"
    module = ast.Module([tree], [])
    ast.increment_lineno(module, law.__code__.co_firstlineno - 1)
    constants = compile(module, law.__code__.co_filename, "exec").co_consts
    (code,) = (item for item in constants if isinstance(item, CodeType))
    return FunctionType(code, law.__globals__ | {"math": math})


class _OverArrays(ast.NodeTransformer):
    """The body of a law with its rows as parts of arrays, and its rates written."""

    def __init__(self, rows: Mapping[str, Argument], *, is_rate: bool) -> None:
        self._rows = rows
        self._is_rate = is_rate

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        self.generic_visit(node)
        if not (isinstance(node.value, ast.Name) and node.value.id in self._rows):
            return node
        row = self._rows[node.value.id]
        index = node.slice
        if row.first:
            index = ast.BinOp(ast.Constant(row.first), ast.Add(), index)
        return ast.copy_location(_element(row.origin, index, node.ctx), node)

    def visit_Return(self, node: ast.Return) -> ast.stmt | list[ast.stmt]:
        if not self._is_rate or node.value is None:
            return node
        values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
        written: list[ast.stmt] = [
            _assign(_element("rates", ast.Constant(index), ast.Store()), value)
            for index, value in enumerate(values)
        ]
        return [ast.copy_location(item, node) for item in (*written, ast.Return())]


def _element(
    origin: Origin, index: ast.expr, context: ast.expr_context | None = None
) -> ast.Subscript:
    return ast.Subscript(ast.Name(origin, ast.Load()), index, context or ast.Load())


def _assign(target: ast.expr, value: ast.expr) -> ast.Assign:
    return ast.Assign([target], value)
