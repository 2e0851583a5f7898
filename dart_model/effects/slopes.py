"""Derivatives of laws, written from their formulas.

A law is a small Python function of named arguments in plain scalar arithmetic. Each of its
statements is followed by those of its derivatives (forward mode), so that the derivatives are
exact. Where a law switches (a branch, `min`, `max`, `abs`, `copysign`, a whole part), they are
those of the side that it takes; where its force jumps there, the jump has none.

Reference: Griewank, Walther, Evaluating Derivatives (2008), 3.
"""

import ast
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, cast

from dart_model.effects.calling import (
    MOTION,
    STRUT,
    ArgumentError,
    arguments,
    function_over_arrays,
    no_rates,
    parse_law,
)
from dart_model.effects.law import Effect, Floats, Force, Rate, Writable

SlopesOverArrays = Callable[
    [float, float, float, float, float, Floats, Floats, Floats, Writable], None
]
"""Arguments of a law over arrays, then where the derivatives are written, row after row."""

_BY = ("height_m", "velocity_m_per_s")
"""Arguments of the motion by which laws are differentiated."""


class _Tangent(NamedTuple):
    """Names of an intermediate value and of its derivatives, by the index in a row."""

    value: ast.expr
    by: Mapping[int, ast.expr]


def row_size(effect: Effect) -> int:
    """Derivatives of a force or of a rate.

    By height, velocity, internal states, parameters, and the strut's constants (`STRUT`).
    """
    return len(_BY) + effect.state_size + len(effect.parameters) + len(STRUT)


@functools.cache
def force_slopes(effect: Effect) -> SlopesOverArrays:
    """The derivatives of the force of an effect, one row.

    Those by a row of parameters that it reads by a computed index, as a table's, are zero.
    """
    return _slopes(effect.force, effect)


@functools.cache
def rate_slopes(effect: Effect) -> SlopesOverArrays:
    """The derivatives of the rates of an effect's internal states, a row for each."""
    return _slopes(effect.rate or no_rates, effect)


def _slopes(law: Force | Rate, effect: Effect) -> SlopesOverArrays:
    tree = parse_law(law, effect)
    body = _Unrolling(law.__globals__).statements(tree.body)
    tree.body = _Differentiation(law, effect, body).statements()
    # Parsed again, as parts of expressions stand in several places.
    text = ast.unparse(ast.fix_missing_locations(tree))
    tree = cast("ast.FunctionDef", ast.parse(text).body[0])
    tree.name = f"{tree.name}_slopes"
    return function_over_arrays(
        law, effect, tree, (*MOTION, "states", "parameters", "strut", "slopes")
    )


class _Unrolling(ast.NodeTransformer):
    """The body of a law with the rounds of its loops one after another."""

    def __init__(self, known: Mapping[str, object]) -> None:
        self._globals = known
        self._round: dict[str, int] = {}

    def statements(self, body: Sequence[ast.stmt]) -> list[ast.stmt]:
        found: list[ast.stmt] = []
        for item in body:
            if isinstance(item, ast.For):
                found += self._rounds(item)
            else:
                found.append(self.visit(_copied(item)))
        return found

    def _rounds(self, loop: ast.For) -> list[ast.stmt]:
        match loop:
            case ast.For(
                target=ast.Name(id=variable),
                iter=ast.Call(func=ast.Name(id="range"), args=[ast.Name(id=rounds)]),
            ):
                count = self._globals[rounds]
            case _:
                raise ArgumentError(f"{ast.unparse(loop.iter)}: expected range of a constant")
        found: list[ast.stmt] = []
        for index in range(int(str(count))):
            self._round = {variable: index}
            found += self.statements(loop.body)
        self._round = {}
        return found

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id in self._round:
            return ast.Constant(self._round[node.id])
        return node


class _Differentiation:
    """The statements of a law, each with those of its derivatives."""

    def __init__(self, law: Force | Rate, effect: Effect, body: Sequence[ast.stmt]) -> None:
        self._body = body
        self._width = row_size(effect)
        self._seeds: dict[str, int] = {}
        self._rows: dict[str, int] = {}
        """First index of each argument that is a row."""
        self._numbers = itertools.count()
        self._active: dict[str, set[int]] = {}
        firsts = {
            "states": len(_BY),
            "parameters": len(_BY) + effect.state_size,
            "strut": len(_BY) + effect.state_size + len(effect.parameters),
        }
        for item in arguments(law, effect):
            if item.origin == "motion":
                if item.name in _BY:
                    self._seeds[item.name] = _BY.index(item.name)
            elif item.origin != "rates":
                first = firsts[item.origin] + item.first
                (self._seeds if item.size is None else self._rows)[item.name] = first

    def statements(self) -> list[ast.stmt]:
        """The whole function's."""
        # What a variable depends on is complete once a pass finds nothing new.
        known = -1
        found: list[ast.stmt] = []
        while (now := sum(map(len, self._active.values()))) != known:
            known = now
            self._numbers = itertools.count()
            found = self._block(self._body)
        return [*found, ast.Return()]

    def _block(self, body: Sequence[ast.stmt]) -> list[ast.stmt]:
        return [line for item in body for line in self._statement(item)]

    def _statement(self, node: ast.stmt) -> Iterator[ast.stmt]:
        match node:
            case ast.Return(value=value):
                values = value.elts if isinstance(value, ast.Tuple) else [value]
                for row, item in enumerate(values):
                    if item is not None:
                        yield from self._write(row, item)
                yield ast.Return()
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                yield from self._assign(name, value)
            case ast.Assign(
                targets=[ast.Subscript(value=ast.Name(id="rates"), slice=ast.Constant(value=row))],
                value=value,
            ):
                yield from self._write(int(str(row)), value)
            case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                yield from self._assign(name, ast.BinOp(_name(name), op, value))
            case ast.If(test=test, body=body, orelse=orelse):
                yield ast.If(test, self._block(body), self._block(orelse))
            case ast.Expr(value=ast.Constant()):
                return
            case _:
                raise ArgumentError(f"{ast.unparse(node)}: expected a statement of a law")

    def _assign(self, name: str, value: ast.expr) -> Iterator[ast.stmt]:
        before, tangent = self._tangent(value)
        yield from before
        self._active.setdefault(name, set()).update(tangent.by)
        # All at once: the value may be one of its own arguments.
        places = sorted(self._active[name])
        targets = [_name(name), *(_name(_derivative(name, place)) for place in places)]
        values = [tangent.value, *(tangent.by.get(place, _ZERO) for place in places)]
        yield _assignment(targets, values)

    def _write(self, row: int, value: ast.expr) -> Iterator[ast.stmt]:
        before, tangent = self._tangent(value)
        yield from before
        for place in range(self._width):
            index = ast.Constant(row * self._width + place)
            target = ast.Subscript(_name("slopes"), index, ast.Store())
            yield ast.Assign([target], tangent.by.get(place, _ZERO))

    # --- expressions ------------------------------------------------------------------------------

    def _tangent(self, node: ast.expr) -> tuple[list[ast.stmt], _Tangent]:
        """Statements that come before, and value and derivatives of an expression."""
        match node:
            case ast.Constant() | ast.Attribute():
                return [], _Tangent(node, {})
            case ast.Name(id=name) if name in self._seeds:
                return [], _Tangent(node, {self._seeds[name]: _ONE})
            case ast.Name(id=name):
                places = self._active.get(name, set())
                by = {place: _name(_derivative(name, place)) for place in places}
                return [], _Tangent(node, by)
            case ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=index)):
                return [], _Tangent(node, {self._rows[name] + int(str(index)): _ONE})
            case ast.Subscript():
                return [], _Tangent(node, {})
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                before, a = self._tangent(operand)
                by = {place: ast.UnaryOp(ast.USub(), each) for place, each in a.by.items()}
                return before, _Tangent(ast.UnaryOp(ast.USub(), a.value), by)
            case ast.BinOp(left=left, op=op, right=right):
                return self._binary(op, left, right)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self._either(test, self._tangent(body), self._tangent(orelse))
            case ast.Call(func=function, args=[a]):
                return self._function(ast.unparse(function), a)
            case ast.Call(func=function, args=[a, b]):
                return self._of_two(ast.unparse(function), a, b)
            case _:
                raise ArgumentError(f"{ast.unparse(node)}: expected an expression of a law")

    def _keep(self, node: ast.expr) -> tuple[list[ast.stmt], _Tangent]:
        """The same with the value in a variable, where it is no name or number."""
        before, a = self._tangent(node)
        if isinstance(a.value, ast.Name | ast.Constant):
            return before, a
        kept = _name(f"value_{next(self._numbers)}")
        return [*before, ast.Assign([kept], a.value)], a._replace(value=_loaded(kept))

    def _combine(
        self, value: ast.expr, parts: Sequence[tuple[ast.expr, _Tangent]]
    ) -> tuple[list[ast.stmt], _Tangent]:
        """Value and derivatives of a function by its slopes towards its arguments."""
        places = sorted({place for _, part in parts for place in part.by})
        number, by, lines = next(self._numbers), dict[int, ast.expr](), list[ast.stmt]()
        for place in places:
            terms = [
                slope if part.by[place] is _ONE else ast.BinOp(slope, ast.Mult(), part.by[place])
                for slope, part in parts
                if place in part.by
            ]
            total = functools.reduce(lambda a, b: ast.BinOp(a, ast.Add(), b), terms)
            kept = _name(f"slope_{number}_{place}")
            lines.append(ast.Assign([kept], total))
            by[place] = _loaded(kept)
        return lines, _Tangent(value, by)

    def _binary(
        self, op: ast.operator, left: ast.expr, right: ast.expr
    ) -> tuple[list[ast.stmt], _Tangent]:
        first, a = self._keep(left)
        second, b = self._keep(right)
        before, value = [*first, *second], ast.BinOp(a.value, op, b.value)
        match op:
            case ast.Add():
                slopes: tuple[ast.expr, ast.expr] = _ONE, _ONE
            case ast.Sub():
                slopes = _ONE, ast.Constant(-1.0)
            case ast.Mult():
                slopes = b.value, a.value
            case ast.Div():
                over = _expression("1.0 / b", b=b.value)
                slopes = over, _expression("-a / (b * b)", a=a.value, b=b.value)
            case ast.Pow():
                return self._power(before, a, b)
            case _:
                raise ArgumentError(f"{ast.unparse(value)}: expected + - * / or **")
        lines, tangent = self._combine(value, list(zip(slopes, (a, b), strict=True)))
        return [*before, *lines], tangent

    def _power(
        self, before: list[ast.stmt], a: _Tangent, b: _Tangent
    ) -> tuple[list[ast.stmt], _Tangent]:
        """A power; of a base that is not positive it has no slope."""
        power = _name(f"value_{next(self._numbers)}")
        value = ast.BinOp(a.value, ast.Pow(), b.value)
        parts = [
            (_expression("b * y / a if a > 0.0 else 0.0", a=a.value, b=b.value, y=power), a),
            (_expression("y * math.log(a) if a > 0.0 else 0.0", a=a.value, y=power), b),
        ]
        lines, tangent = self._combine(_loaded(power), [p for p in parts if p[1].by])
        return [*before, ast.Assign([power], value), *lines], tangent

    def _function(self, name: str, argument: ast.expr) -> tuple[list[ast.stmt], _Tangent]:
        if name == "int":
            return [], _Tangent(ast.Call(_name("int"), [argument], []), {})
        before, a = self._keep(argument)
        result = _name(f"value_{next(self._numbers)}")
        call = ast.Call(ast.parse(name, mode="eval").body, [a.value], [])
        slope = _expression(_SLOPES[name], a=a.value, y=result)
        lines, tangent = self._combine(_loaded(result), [(slope, a)])
        return [*before, ast.Assign([result], call), *lines], tangent

    def _of_two(
        self, name: str, left: ast.expr, right: ast.expr
    ) -> tuple[list[ast.stmt], _Tangent]:
        first, a = self._keep(left)
        second, b = self._keep(right)
        before = [*first, *second]
        if name == "math.copysign":
            value = ast.Call(ast.parse(name, mode="eval").body, [a.value, b.value], [])
            sign = _expression(
                "math.copysign(1.0, a) * math.copysign(1.0, b)", a=a.value, b=b.value
            )
            lines, tangent = self._combine(value, [(sign, a)])
            return [*before, *lines], tangent
        test = {"max": "b > a", "min": "b < a"}[name]
        lines, tangent = self._either(_expression(test, a=a.value, b=b.value), ([], b), ([], a))
        return [*before, *lines], tangent

    def _either(
        self,
        test: ast.expr,
        one: tuple[list[ast.stmt], _Tangent],
        other: tuple[list[ast.stmt], _Tangent],
    ) -> tuple[list[ast.stmt], _Tangent]:
        number = next(self._numbers)
        places = sorted({*one[1].by, *other[1].by})
        names = [f"value_{number}", *(f"slope_{number}_{place}" for place in places)]
        branches = [
            [
                *before,
                _assignment(
                    [_name(name) for name in names],
                    [tangent.value, *(tangent.by.get(place, _ZERO) for place in places)],
                ),
            ]
            for before, tangent in (one, other)
        ]
        by = {place: _name(name) for place, name in zip(places, names[1:], strict=True)}
        return [ast.If(test, branches[0], branches[1])], _Tangent(_name(names[0]), by)


_ZERO, _ONE = ast.Constant(0.0), ast.Constant(1.0)
_SLOPES = {
    "math.exp": "y",
    "math.tanh": "1.0 - y * y",
    "math.sqrt": "0.5 / y if y > 0.0 else 0.0",
    "math.sin": "math.cos(a)",
    "math.cos": "-math.sin(a)",
    "math.sinh": "math.sqrt(1.0 + y * y)",
    "math.atan": "1.0 / (1.0 + a * a)",
    "abs": "math.copysign(1.0, a)",
}
"""Slope of a function with the argument `a` and the value `y`."""


def _derivative(name: str, place: int) -> str:
    return f"{name}_by_{place}"


def _name(name: str) -> ast.Name:
    return ast.Name(name, ast.Load())


def _loaded(name: ast.Name) -> ast.Name:
    return ast.Name(name.id, ast.Load())


def _copied(node: ast.stmt) -> ast.stmt:
    return ast.parse(ast.unparse(node)).body[0]


def _expression(text: str, **names: ast.expr) -> ast.expr:
    """An expression with other expressions for its names."""

    class _Names(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            return names.get(node.id, node)

    return _Names().visit(ast.parse(text, mode="eval").body)


def _assignment(targets: Sequence[ast.Name], values: Sequence[ast.expr]) -> ast.stmt:
    stored = [ast.Name(item.id, ast.Store()) for item in targets]
    if len(stored) == 1:
        return ast.Assign([stored[0]], values[0])
    return ast.Assign([ast.Tuple([*stored], ast.Store())], ast.Tuple([*values], ast.Load()))
