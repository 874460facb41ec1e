"""A tuple of arrays that is handed to kernels as one object.

A kernel looks at each array of a tuple at every call, and counts references to it, which takes longer than what it does
with those of a few vehicles: 0.2 µs an array. A handle is looked at once. Importing this imports Numba.
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
    """In a kernel, its attribute `arrays` is the tuple. Whoever replaces an array of it makes a new handle."""

    kept: Any
    """The tuple; while it exists, so do the arrays."""


_structref.define_proxy(Handle, _HandleType, ["arrays"])


def handle(arrays: Any) -> Handle:
    """A handle on a tuple of arrays, or of such tuples."""
    made: Handle = _handle(arrays)
    made.kept = arrays
    return made


@array_kernel
def _handle(arrays: Any) -> Any:
    """What is kept of it on disk names the classes of the tuples: when one is renamed, this file has to change, too."""
    return Handle(_borrowed(arrays))


@_intrinsic
def _borrowed(_: Any, arrays: Any) -> Any:
    """The same arrays, to which kernels count no references."""

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
