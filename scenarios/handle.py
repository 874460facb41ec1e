"""Passes a tuple of arrays to kernels as one object.

At every call a kernel unpacks each array of a tuple and counts references to it: 0.2 µs an array, longer than its own
work on a few vehicles. A handle is unpacked once. Importing this module imports Numba.
"""

from typing import Any

import numba
from numba.core import cgutils
from numba.experimental import structref
from numba.extending import intrinsic

from scenarios.kernel import array_kernel

_types: Any = numba.types
_structref: Any = structref
_intrinsic: Any = intrinsic


@_structref.register
class _HandleType(_types.StructRef):
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, _types.unliteral(kind)) for name, kind in fields)


class Handle(structref.StructRefProxy):
    """In a kernel, its attribute `arrays` is the tuple. Replacing one of the arrays requires a new handle."""

    kept: Any
    """The tuple, which keeps the arrays alive."""


_structref.define_proxy(Handle, _HandleType, ["arrays"])


def handle(arrays: Any) -> Handle:
    """A handle on a tuple of arrays, or of such tuples."""
    made: Handle = _handle(arrays)
    made.kept = arrays
    return made


@array_kernel
def _handle(arrays: Any) -> Any:
    return Handle(_borrowed(arrays))


@_intrinsic
def _borrowed(_: Any, arrays: Any) -> Any:
    """The same arrays without owners, so that kernels count no references to them."""

    def without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        if isinstance(kind, _types.Array):
            array = context.make_array(kind)(context, builder, value)
            array.meminfo, array.parent = (cgutils.get_null_value(part.type) for part in (array.meminfo, array.parent))
            return array._getvalue()
        for place, part in enumerate(kind.types if isinstance(kind, _types.BaseTuple) else ()):
            inner = without_owner(context, builder, part, builder.extract_value(value, place))
            value = builder.insert_value(value, inner, place)
        return value

    def generated(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        return without_owner(context, builder, arrays, arguments[0])

    return arrays(arrays), generated
