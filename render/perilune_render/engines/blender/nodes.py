"""Build shader nodes from Python arithmetic, so that one formula serves NumPy arrays and the shader.

Each operator or NumPy ufunc applied to a `Symbol` adds a Math node to the tree. Adding to a product makes one node that
multiplies and adds, since the run time of a shader grows with the number of nodes. Nodes without a link to the output
cost nothing.
"""

import numbers
from typing import Any

import bpy
import numpy as np

_OPERATIONS = {
    np.add: "ADD",
    np.subtract: "SUBTRACT",
    np.multiply: "MULTIPLY",
    np.true_divide: "DIVIDE",
    np.power: "POWER",
    np.maximum: "MAXIMUM",
    np.minimum: "MINIMUM",
    np.sqrt: "SQRT",
    np.exp: "EXPONENT",
    np.arccos: "ARCCOSINE",
    np.cos: "COSINE",
    np.sin: "SINE",
    np.tan: "TANGENT",
    np.arctan: "ARCTANGENT",
    np.absolute: "ABSOLUTE",
}


class Symbol(np.lib.mixins.NDArrayOperatorsMixin):
    """A float value in a shader: the output socket of a node.

    `factors` holds the two factors if the value is a product, else it is empty.
    """

    def __init__(self, tree: bpy.types.NodeTree, socket: bpy.types.NodeSocket, factors: tuple[Any, ...] = ()):
        self.tree = tree
        self.socket = socket
        self.factors = factors

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> "Symbol":
        if method != "__call__" or kwargs or ufunc not in _OPERATIONS:
            return NotImplemented
        operation = _OPERATIONS[ufunc]
        if operation == "ADD":
            first, second = inputs if isinstance(inputs[0], Symbol) and inputs[0].factors else inputs[::-1]
            if isinstance(first, Symbol) and first.factors:
                operation, inputs = "MULTIPLY_ADD", (*first.factors, second)
        node = self.tree.nodes.new("ShaderNodeMath")
        node.operation = operation
        for socket, value in zip(node.inputs, inputs, strict=False):
            if isinstance(value, Symbol):
                self.tree.links.new(value.socket, socket)
            elif isinstance(value, numbers.Real):
                socket.default_value = float(value)
            else:
                return NotImplemented
        return Symbol(self.tree, node.outputs[0], inputs if operation == "MULTIPLY" else ())


def at_least(value: Symbol, least: float) -> Symbol:
    """The larger of a symbol and a number. The type hints of np.maximum accept only arrays."""
    return value.__array_ufunc__(np.maximum, "__call__", value, least)


def dot(
    tree: bpy.types.NodeTree, first: bpy.types.NodeSocket, second: bpy.types.NodeSocket | tuple[float, ...]
) -> Symbol:
    """Dot product of two vectors; the second may be a constant."""
    node = tree.nodes.new("ShaderNodeVectorMath")
    node.operation = "DOT_PRODUCT"
    tree.links.new(first, node.inputs[0])
    if isinstance(second, bpy.types.NodeSocket):
        tree.links.new(second, node.inputs[1])
    else:
        node.inputs[1].default_value = second
    return Symbol(tree, node.outputs["Value"])
