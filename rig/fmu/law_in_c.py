"""A law of the catalogue as C, read from the one file in which it is written.

A law is a small Python function of named arguments in plain scalar arithmetic. Its syntax tree is
translated statement by statement, so that the C computes what the Python computes, in the same
order: the two agree to the last bits of the mathematical functions. Whatever a law may not use is
refused, with its line.

Where a law switches (a comparison, `min`, `max`, `abs`, `copysign`, a whole part), the C asks a
switch with a number. A solver that steps over the laws may hold all switches, so
that what it integrates is smooth, and look at their indicators for the time at which one turns
(Cellier and Kofman, "Continuous System Simulation" (2006), chapter 9).
"""

import ast
import inspect
import textwrap
from collections.abc import Mapping
from typing import NamedTuple

from dart_model.effects.law import Force, Rate

_C_TYPES: Mapping[str, str] = {
    "float": "double ",
    "Floats": "const double *",
    "Writable": "double *",
}
"""Types of a law's arguments, and what they are in C."""
_ROWS = ("Floats", "Writable")

_FUNCTIONS: Mapping[str, str] = {
    "math.exp": "exp",
    "math.tanh": "tanh",
    "math.sqrt": "root",
    "math.sin": "sin",
    "math.cos": "cos",
    "math.sinh": "sinh",
    "math.atan": "atan",
}
_SWITCHING: Mapping[str, tuple[str, int]] = {
    "int": ("whole_part", 1),
    "max": ("larger", 2),
    "min": ("smaller", 2),
    "abs": ("magnitude", 1),
    "math.copysign": ("signed_as", 2),
}
_CONSTANTS: Mapping[str, str] = {"math.inf": "INFINITY", "math.pi": "3.141592653589793"}
_COMPARISONS: Mapping[type[ast.AST], str] = {
    ast.Lt: "is_less",
    ast.LtE: "is_at_most",
    ast.Gt: "is_more",
    ast.GtE: "is_at_least",
}
_OPERATORS: Mapping[type[ast.AST], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}


class NoLawError(ValueError):
    """A function uses what no law may use."""


class InC(NamedTuple):
    """A law in C.

    Attributes:
        text: A static function of its switches, then the law's own arguments: rows as pointers.
        switches: Number of its switches.
        writes: Whether it writes rates behind a last argument, rather than to return its value.
    """

    text: str
    switches: int
    writes: bool


def in_c(law: Force | Rate, name: str) -> InC:
    """The force or the rate of an effect as a C function of some name.

    Raises:
        NoLawError: It uses what no law may use.
    """
    tree = ast.parse(textwrap.dedent(inspect.getsource(law))).body[0]
    if not isinstance(tree, ast.FunctionDef):
        raise NoLawError(f"{name}: expected a function")
    return _Translation(law.__globals__, tree, name).function()


class _Translation:
    """The translation of one function."""

    def __init__(self, known: Mapping[str, object], tree: ast.FunctionDef, name: str) -> None:
        self._globals = known
        self._tree = tree
        self._name = name
        self._arguments = {
            item.arg: ast.unparse(item.annotation) if item.annotation else ""
            for item in tree.args.args
        }
        self._declared: dict[str, bool] = {}
        """Its variables, and whether each is a whole number."""
        self._switches = 0
        self._loop: tuple[str, int] | None = None
        """Variable of the loop that is being translated, and the switches of each of its rounds."""

    def function(self) -> InC:
        """The function in C."""
        body = self._block(self._tree.body)
        returns = ast.unparse(self._tree.returns) if self._tree.returns else ""
        arguments = ["const Switches *s"]
        for name, annotation in self._arguments.items():
            if annotation not in _C_TYPES:
                raise NoLawError(f"{self._name}: {name}: expected one of {', '.join(_C_TYPES)}")
            arguments.append(f"{_C_TYPES[annotation]}{name}")
        if returns == "Rates":
            arguments.append("double *rates")
        writes = returns != "float"
        head = f"static {'void' if writes else 'double'} {self._name}({', '.join(arguments)}) {{"
        declared = [
            f"    {'long' if is_whole else 'double'} {name};"
            for name, is_whole in self._declared.items()
        ]
        lines = [head, *declared, "    (void)s;", *body, "}"]
        return InC("\n".join(lines) + "\n", self._switches, writes)

    def _block(self, statements: list[ast.stmt]) -> list[str]:
        return [f"    {line}" for item in statements for line in self._statement(item)]

    def _statement(self, node: ast.stmt) -> list[str]:
        match node:
            case ast.Return(value=ast.Tuple(elts=values)):
                written = (f"rates[{k}] = {self._real(item)};" for k, item in enumerate(values))
                return [*written, "return;"]
            case ast.Return(value=value) if value is not None:
                return [f"return {self._real(value)};"]
            case ast.Assign(targets=[target], value=value):
                return [f"{self._assign(target, value)};"]
            case ast.AugAssign(target=ast.Name(id=name), op=op, value=value):
                return [f"{name} {self._operator(op, node)}= {self._real(value)};"]
            case ast.If(test=test, body=body, orelse=orelse):
                lines = [f"if ({self._expression(test)}) {{", *self._block(body)]
                if orelse:
                    lines += ["} else {", *self._block(orelse)]
                return [*lines, "}"]
            case ast.For(
                target=ast.Name(id=name),
                iter=ast.Call(func=ast.Name(id="range"), args=[ast.Name(id=rounds)]),
                body=body,
                orelse=[],
            ) if self._loop is None:
                return self._for(name, int(self._global(rounds, node)), body)
            case ast.Expr(value=ast.Constant(value=str())):
                return []
            case _:
                raise self._refusal(node)

    def _for(self, name: str, rounds: int, body: list[ast.stmt]) -> list[str]:
        self._declare(name, whole=True)
        first = self._switches
        self._loop = name, 0
        self._block(body)  # counts the switches of a round
        each = self._switches - first
        self._loop = name, each
        self._switches = first
        lines = self._block(body)
        self._switches = first + rounds * each
        self._loop = None
        return [f"for ({name} = 0; {name} < {rounds}; ++{name}) {{", *lines, "}"]

    def _assign(self, target: ast.expr, value: ast.expr) -> str:
        match target:
            case ast.Name(id=name):
                is_whole = self._is_whole(value)
                self._declare(name, whole=is_whole)
                text = self._expression(value) if is_whole else self._real(value)
                return f"{name} = {text}"
            case ast.Subscript(value=ast.Name(id=name), slice=index) if self._is_row(name):
                return f"{name}[{self._expression(index)}] = {self._real(value)}"
            case _:
                raise self._refusal(target)

    def _declare(self, name: str, *, whole: bool) -> None:
        if name in self._arguments:
            raise NoLawError(f"{self._name}: {name}: an argument is given another value")
        if self._declared.setdefault(name, whole) != whole:
            raise NoLawError(f"{self._name}: {name}: a whole number and a real one")

    def _is_row(self, name: str) -> bool:
        return self._arguments.get(name) in _ROWS

    def _is_whole(self, node: ast.expr) -> bool:
        """Whether an expression is a whole number in Python."""
        match node:
            case ast.Constant(value=value):
                return isinstance(value, int)
            case ast.Name(id=name) if name in self._declared or name in self._arguments:
                return self._declared.get(name, False)
            case ast.Name(id=name):
                return isinstance(self._global(name, node), int)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult(), right=right):
                return self._is_whole(left) and self._is_whole(right)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._is_whole(operand)
            case ast.Call(func=ast.Name(id="int")):
                return True
            case _:
                return False

    def _real(self, node: ast.expr) -> str:
        text = self._expression(node)
        return f"(double)({text})" if self._is_whole(node) else text

    def _expression(self, node: ast.expr) -> str:
        match node:
            case ast.Constant(value=int() | float()) if not isinstance(node.value, bool):
                return repr(node.value)
            case ast.Name(id=name) if name in self._declared or name in self._arguments:
                return name
            case ast.Name(id=name):
                return repr(self._global(name, node))
            case ast.Attribute() if ast.unparse(node) in _CONSTANTS:
                return _CONSTANTS[ast.unparse(node)]
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"(-{self._expression(operand)})"
            case ast.BinOp(left=left, op=op, right=right):
                return self._arithmetic(left, op, right)
            case ast.BoolOp(op=op, values=values):
                sign = " || " if isinstance(op, ast.Or) else " && "
                return f"({sign.join(self._expression(item) for item in values)})"
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARISONS:
                return self._switch(_COMPARISONS[type(op)], [left, right])
            case ast.IfExp(test=test, body=body, orelse=orelse):
                chosen = f"{self._real(body)} : {self._real(orelse)}"
                return f"({self._expression(test)} ? {chosen})"
            case ast.Subscript(value=ast.Name(id=name), slice=index) if self._is_row(name):
                return f"{name}[{self._expression(index)}]"
            case ast.Call(func=function, args=arguments, keywords=[]):
                return self._call(ast.unparse(function), arguments, node)
            case _:
                raise self._refusal(node)

    def _arithmetic(self, left: ast.expr, op: ast.operator, right: ast.expr) -> str:
        if isinstance(op, ast.Pow):
            return f"power({self._real(left)}, {self._real(right)})"
        both_whole = self._is_whole(left) and self._is_whole(right) and not isinstance(op, ast.Div)
        side = self._expression if both_whole else self._real
        return f"({side(left)} {self._operator(op, left)} {side(right)})"

    def _call(self, called: str, arguments: list[ast.expr], node: ast.expr) -> str:
        if called in _SWITCHING and len(arguments) == _SWITCHING[called][1]:
            return self._switch(_SWITCHING[called][0], arguments)
        if called in _FUNCTIONS and len(arguments) == 1:
            return f"{_FUNCTIONS[called]}({self._real(arguments[0])})"
        raise self._refusal(node)

    def _switch(self, function: str, arguments: list[ast.expr]) -> str:
        index = str(self._switches)
        self._switches += 1
        if self._loop is not None:
            variable, each = self._loop
            index += f" + {each} * {variable}"
        return f"{function}(s, {index}, {', '.join(self._real(item) for item in arguments)})"

    def _global(self, name: str, node: ast.AST) -> float:
        value = self._globals.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._refusal(node)
        return value

    def _operator(self, op: ast.AST, node: ast.AST) -> str:
        sign = _OPERATORS.get(type(op))
        if sign is None:
            raise self._refusal(node)
        return sign

    def _refusal(self, node: ast.AST) -> NoLawError:
        line = getattr(node, "lineno", 0)
        return NoLawError(f"{self._name}: line {line}: {ast.unparse(node)}: no law may use this")
