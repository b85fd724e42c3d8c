"""Conditions on columns, as `--where` takes them: Python's own notation, of which only arithmetic is understood.

A condition is read by `ast` and walked here; nothing of it is ever executed. Columns go by name, or by `table.column`
where several tables have it; `position_m[2]` is an element of a vector.
"""

import ast
import difflib
import operator
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.schema import TABLES

_SEARCHED = ("frames", "labels", "scenes", "craters", "trajectories")
"""Where a bare name is looked for, first to last."""
_BINARY: dict[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: operator.mod,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_FUNCTIONS: dict[str, Callable] = {"abs": np.abs, "sqrt": np.sqrt, "log10": np.log10}
_LONGEST = 2000


class Condition:
    """A parsed condition."""

    def __init__(self, text: str):
        """Raises UserError on what is no condition, or names no column."""
        self.text = text
        try:
            if len(text) > _LONGEST:
                raise ValueError(f"{len(text)} characters")
            self._tree = ast.parse(text.strip(), mode="eval").body
            self.columns: set[tuple[str, str]] = set()
            self._walk(self._tree, None)
        except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError) as error:
            raise self._fault(text, f"a condition such as radius_px > 5 and split == 'test' ({error})") from None
        if not self.columns:
            raise self._fault(text, "a condition on columns")

    @property
    def on_labels(self) -> bool:
        """Whether it chooses labels rather than frames."""
        return any(table in ("labels", "craters") for table, _ in self.columns)

    def holds(self, columns: dict[tuple[str, str], np.ndarray], n_rows: int) -> np.ndarray:
        """Where it holds (n_rows,) bool, given the columns (n_rows,) or (n_rows, k) by table and name."""
        try:
            with np.errstate(all="ignore"):
                result = np.asarray(self._walk(self._tree, columns))
        except (TypeError, ValueError, IndexError, ArithmeticError, RecursionError) as error:
            raise self._fault(self.text, f"numbers with numbers and text with text ({error})") from None
        if result.dtype != np.bool_ or result.shape not in ((), (n_rows,)):
            raise self._fault(self.text, "a condition that is true or false for each row")
        return np.broadcast_to(result, (n_rows,))

    def _walk(self, node: ast.expr, columns: dict[tuple[str, str], np.ndarray] | None) -> Any:
        """The value of a node, or, without columns, a check of it that gathers the columns' names."""
        checking = columns is None

        def walk(child: ast.expr) -> Any:
            return self._walk(child, columns)

        if isinstance(node, ast.Name | ast.Attribute):
            key = self._column(node)
            self.columns.add(key)
            return None if columns is None else columns[key]
        if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float | str):
            return node.value
        if isinstance(node, ast.BoolOp):
            values = [walk(value) for value in node.values]
            join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
            return None if checking else join.reduce(np.broadcast_arrays(*map(_truth, values)))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            value = walk(node.operand)
            return None if checking else ~_truth(value) if isinstance(node.op, ast.Not) else operator.neg(value)
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            left, right = walk(node.left), walk(node.right)
            if not checking and any(np.asarray(value).dtype.kind in "OU" for value in (left, right)):
                raise TypeError("text takes part in comparisons alone")  # times a number it has no end
            return None if checking else _BINARY[type(node.op)](left, right)
        if isinstance(node, ast.Compare):
            values = [walk(value) for value in (node.left, *node.comparators)]
            found = [self._compared(op, a, b, checking) for op, a, b in zip(node.ops, values, values[1:], strict=False)]
            return None if checking else np.logical_and.reduce(np.broadcast_arrays(*found))
        if isinstance(node, ast.Tuple | ast.List):
            return [walk(element) for element in node.elts]
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant) and type(node.slice.value) is int:
            value = walk(node.value)
            return None if checking else np.asarray(value)[:, node.slice.value]
        if isinstance(node, ast.Call) and ast.unparse(node.func) in _FUNCTIONS and len(node.args) == 1:
            value = walk(node.args[0])
            return None if checking else _FUNCTIONS[ast.unparse(node.func)](value)
        raise self._fault(ast.unparse(node), "columns, numbers, text, + - * / %, comparisons, in, and, or, not")

    def _compared(self, op: ast.cmpop, left: Any, right: Any, checking: bool) -> Any:
        if type(op) in _BINARY:
            return None if checking else _BINARY[type(op)](left, right)
        if isinstance(op, ast.In | ast.NotIn):
            if not isinstance(right, list):
                raise self._fault(self.text, "a list after `in`, such as split in ('val', 'test')")
            return None if checking else np.isin(left, right, invert=isinstance(op, ast.NotIn))
        raise self._fault(self.text, "comparisons by == != < <= > >= in")

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
        near = difflib.get_close_matches(node.id, known, n=1)
        raise self._fault(node.id, f"{near[0]}?" if near else "a column of " + ", ".join(_SEARCHED))

    @staticmethod
    def _fault(found: str, wanted: str) -> UserError:
        return UserError("--where", "condition", found, wanted)


def _truth(value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype != np.bool_:
        raise TypeError("and, or, not join conditions")
    return array


def columns_of(conditions: Iterable[Condition]) -> set[tuple[str, str]]:
    """All columns, as (table, name), that conditions need."""
    return {key for condition in conditions for key in condition.columns}
