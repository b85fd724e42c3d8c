"""Conditions on columns for the option `--where`: arithmetic and comparisons in Python syntax.

A condition is parsed with `ast`, type-checked against the schema, and compiled to an expression of pyarrow.compute. It
is never executed as Python code. A column is given by its name, or as `table.column` if several tables have a column of
this name; `position_m[2]` is an element of a vector. As in SQL, a comparison with null is neither true nor false.
"""

import ast
import difflib
import functools
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError

_SEARCHED = ("frames", "labels", "scenes", "craters", "trajectories")
"""Tables that conditions may use, in the order in which a column name without a table is looked up."""
_COMPARISONS: dict[type, Callable] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_ARITHMETIC: dict[type, Callable] = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul}
_FUNCTIONS: dict[str, Callable] = {"abs": pc.abs, "sqrt": pc.sqrt, "log10": pc.log10}
_MAX_LENGTH = 2000
_SUPPORTED = "columns, numbers, text, + - * / %, abs, sqrt, log10, comparisons, in, and, or, not"
_Kind = Literal["integer", "real", "text", "boolean", "vector"]


@dataclass(frozen=True, slots=True)
class _Value:
    """A subexpression of a condition."""

    kind: _Kind
    """Type of the values."""
    expression: Any
    """The pyarrow expression."""
    length: int = 0
    """Number of elements of a vector."""

    @property
    def is_number(self) -> bool:
        return self.kind in ("integer", "real")


class Condition:
    """A parsed condition on frames or labels."""

    def __init__(self, text: str):
        """Parse `text`. Raises UserError on invalid syntax, unknown columns or mismatched types."""
        self.text = text
        self.columns: set[tuple[str, str]] = set()
        self._joined = self._compiled(lambda table, name: f"{table}.{name}")
        if not self.columns:
            raise self._fault(text, "a condition on columns")

    @property
    def on_labels(self) -> bool:
        """Whether the condition selects labels; otherwise it selects frames."""
        return any(table in ("labels", "craters") for table, _ in self.columns)

    def columns_of_only(self, table: str) -> list[str] | None:
        """Return the columns that the condition uses, or None if not all of them belong to `table`."""
        return (
            sorted(name for _, name in self.columns) if {table} == {of_table for of_table, _ in self.columns} else None
        )

    def within_table(self) -> Any:
        """Return the pyarrow expression with plain column names, for a condition on one table."""
        return self._compiled(lambda table, name: name)

    def holds(self, rows: pa.Table) -> NDArray[np.bool_]:
        """Return for each row (N,) whether the condition is true. Raises UserError if numbers overflow.

        The columns of `rows` are named `table.column`.
        """
        mask = np.zeros(len(rows), np.bool_)
        try:
            rows_that_hold = rows.append_column("", pa.array(np.arange(len(rows)))).filter(self._joined)
        except pa.ArrowException as error:
            raise self._fault(self.text, f"numbers within the range of their columns ({error})") from None
        mask[rows_that_hold[""].to_numpy()] = True
        return mask

    def _compiled(self, name_of: Callable[[str, str], str]) -> Any:
        try:
            if len(self.text) > _MAX_LENGTH:
                raise ValueError(f"{len(self.text)} characters")
            value = self._walk(ast.parse(self.text.strip(), mode="eval").body, name_of)
        except (
            SyntaxError,
            TypeError,
            ValueError,
            OverflowError,
            RecursionError,
            MemoryError,
            pa.ArrowException,
        ) as error:
            expected = f"a condition such as radius_px > 5 and split == 'test' ({error})"
            raise self._fault(self.text, expected) from None
        if value.kind != "boolean":
            raise self._fault(self.text, "a condition that is true or false for each row")
        return value.expression

    def _walk(self, node: ast.expr, name_of: Callable[[str, str], str]) -> _Value:
        def walk(child: ast.expr) -> _Value:
            return self._walk(child, name_of)

        match node:
            case ast.Name() | ast.Attribute():
                table, name = self._column(node)
                self.columns.add((table, name))
                return _column_value(TABLES[table].field(name).type, pc.field(name_of(table, name)))
            case ast.Constant(value=bool() | int() | float() | str() as constant):
                return _constant(constant)
            case ast.BoolOp():
                join = operator.and_ if isinstance(node.op, ast.And) else operator.or_
                values = [self._boolean(walk(value), value) for value in node.values]
                return _Value("boolean", functools.reduce(join, values))
            case ast.UnaryOp(op=ast.Not()):
                return _Value("boolean", ~self._boolean(walk(node.operand), node.operand))
            case ast.UnaryOp(op=ast.USub()):
                value = self._number(walk(node.operand), node.operand)
                return _Value(value.kind, pc.negate_checked(value.expression))
            case ast.BinOp():
                left, right = (self._number(walk(side), side) for side in (node.left, node.right))
                return self._arithmetic(node, left, right)
            case ast.Compare():
                return self._compare(node, walk)
            case ast.Subscript(slice=ast.Constant(value=int() as index)) if not isinstance(index, bool):
                value = walk(node.value)
                if value.kind != "vector" or index >= value.length:
                    raise self._fault(
                        ast.unparse(node), f"an element 0 to {value.length - 1}" if value.length else _SUPPORTED
                    )
                return _Value("real", pc.list_element(value.expression, index))
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
                value = self._number(walk(argument), argument)
                if name == "abs":
                    return _Value(value.kind, pc.abs_checked(value.expression))
                return _Value("real", _FUNCTIONS[name](value.expression.cast(pa.float64())))
            case ast.Call(func=ast.Name(id=name)) if name in _FUNCTIONS:
                raise self._fault(ast.unparse(node), f"one positional argument of {name}")
        raise self._fault(ast.unparse(node), _SUPPORTED)

    def _arithmetic(self, node: ast.BinOp, left: _Value, right: _Value) -> _Value:
        a, b = left.expression, right.expression
        integers = left.kind == right.kind == "integer"
        kind: _Kind = "integer" if integers else "real"
        if type(node.op) in _ARITHMETIC:
            return _Value(kind, _ARITHMETIC[type(node.op)](a, b))
        if isinstance(node.right, ast.Constant) and node.right.value == 0:
            raise self._fault(ast.unparse(node), "a divisor other than 0")
        real_a, real_b = a.cast(pa.float64()), b.cast(pa.float64())
        if isinstance(node.op, ast.Div):
            return _Value("real", pc.divide(real_a, real_b))
        if isinstance(node.op, ast.Mod) and integers:
            # Arrow's division truncates towards zero. In Python the remainder has the divisor's sign.
            remainder = a - b * pc.divide(a, b)
            return _Value(kind, pc.if_else((remainder != 0) & pc.xor(remainder < 0, b < 0), remainder + b, remainder))
        if isinstance(node.op, ast.Mod):
            return _Value(kind, real_a - pc.floor(pc.divide(real_a, real_b)) * real_b)
        raise self._fault(ast.unparse(node), _SUPPORTED)

    def _compare(self, node: ast.Compare, walk: Callable[[ast.expr], _Value]) -> _Value:
        sides = [node.left, *node.comparators]
        comparisons = []
        for op, left, right in zip(node.ops, sides, sides[1:], strict=False):
            if isinstance(op, ast.In | ast.NotIn):
                is_in = self._is_in(walk(left), left, right)
                comparisons.append(is_in if isinstance(op, ast.In) else ~is_in)
            elif type(op) in _COMPARISONS:
                a, b = walk(left), walk(right)
                if not ((a.is_number and b.is_number) or a.kind == b.kind == "text"):
                    raise self._fault(
                        f"{ast.unparse(left)} ({a.kind}) with {ast.unparse(right)} ({b.kind})",
                        "comparisons of numbers with numbers and text with text",
                    )
                comparisons.append(_COMPARISONS[type(op)](a.expression, b.expression))
            else:
                raise self._fault(ast.unparse(node), "one of == != < <= > >= in")
        return _Value("boolean", functools.reduce(operator.and_, comparisons))

    def _is_in(self, value: _Value, left: ast.expr, right: ast.expr) -> Any:
        if not isinstance(right, ast.Tuple | ast.List) or not right.elts:
            raise self._fault(ast.unparse(right), "a list after `in`, such as split in ('val', 'test')")
        try:
            items = [ast.literal_eval(item) for item in right.elts]
        except ValueError:
            raise self._fault(ast.unparse(right), "a list of numbers or of text") from None
        texts = all(isinstance(item, str) for item in items)
        numbers = all(isinstance(item, int | float) and not isinstance(item, bool) for item in items)
        if not ((texts and value.kind == "text") or (numbers and value.is_number)):
            expected = "comparisons of numbers with numbers and text with text"
            raise self._fault(f"{ast.unparse(left)} ({value.kind}) in {ast.unparse(right)}", expected)
        if texts:
            matches = value.expression.isin(pa.array(items, pa.string()))
        elif value.kind == "integer" and all(isinstance(item, int) for item in items):
            matches = value.expression.isin(pa.array(items, pa.int64()))
        else:
            matches = value.expression.cast(pa.float64()).isin(pa.array([float(item) for item in items]))
        # pyarrow evaluates `null in list` as false, so `null not in list` would be true; return null.
        return pc.if_else(value.expression.is_valid(), matches, pa.scalar(None, pa.bool_()))

    def _number(self, value: _Value, node: ast.expr) -> _Value:
        if not value.is_number:
            hint = f"; write {ast.unparse(node)}[0] for the first element" if value.kind == "vector" else ""
            raise self._fault(f"{ast.unparse(node)} ({value.kind})", f"a number{hint}")
        return value

    def _boolean(self, value: _Value, node: ast.expr) -> Any:
        if value.kind != "boolean":
            raise self._fault(f"{ast.unparse(node)} ({value.kind})", "conditions as operands of and, or, not")
        return value.expression

    def _column(self, node: ast.Name | ast.Attribute) -> tuple[str, str]:
        if isinstance(node, ast.Attribute):
            table, name = (node.value.id, node.attr) if isinstance(node.value, ast.Name) else ("", node.attr)
            if table in _SEARCHED and name in TABLES[table].names:
                return table, name
            raise self._fault(ast.unparse(node), f"table.column, with one of {', '.join(_SEARCHED)}")
        for table in _SEARCHED:
            if node.id in TABLES[table].names:
                return table, node.id
        known = sorted({name for table in _SEARCHED for name in TABLES[table].names})
        similar = difflib.get_close_matches(node.id, known, n=1)
        raise self._fault(
            node.id, f"{similar[0]} (nearest known)" if similar else "a column of " + ", ".join(_SEARCHED)
        )

    @staticmethod
    def _fault(found: str, expected: str) -> UserError:
        return UserError("--where", "", found, expected)


def _column_value(kind: pa.DataType, expression: Any) -> _Value:
    if pa.types.is_fixed_size_list(kind):
        return _Value("vector", expression, kind.list_size)
    return _Value(
        "text" if pa.types.is_string(kind) else "integer" if pa.types.is_integer(kind) else "real", expression
    )


def _constant(value: bool | float | str) -> _Value:
    kinds: dict[type, _Kind] = {bool: "boolean", int: "integer", float: "real", str: "text"}
    return _Value(kinds[type(value)], pc.scalar(value))


def columns_of(conditions: Iterable[Condition]) -> set[tuple[str, str]]:
    """Return the columns that the conditions use, each as (table, name)."""
    return {key for condition in conditions for key in condition.columns}
