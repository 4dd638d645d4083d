"""Types of the arguments of kernels, precise enough to compile these before their first call.

Each entry takes contiguous arrays of one number of dimensions. An array of another layout would be compiled for anew.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final, get_args, get_origin, get_type_hints

from numba.core import types

from groundsbot.calib.foundation import BoolArray, FloatArray, IndexArray, IntArray

FloatVector = Annotated[FloatArray, types.float64[::1]]
FloatMatrix = Annotated[FloatArray, types.float64[:, ::1]]
FloatBlocks = Annotated[FloatArray, types.float64[:, :, ::1]]
IntVector = Annotated[IntArray, types.int64[::1]]
IntMatrix = Annotated[IntArray, types.int64[:, ::1]]
IndexMatrix = Annotated[IndexArray, types.int32[:, ::1]]
BoolVector = Annotated[BoolArray, types.boolean[::1]]

_NUMBERS: Final = {float: types.float64, int: types.int64, bool: types.boolean}


def argument_types(function: Callable[..., object]) -> tuple[Any, ...]:
    """Return numba's types of a function's arguments.

    Raises:
        TypeError: an annotation does not say how many dimensions an array has.
    """
    hints = get_type_hints(function, include_extras=True)
    hints.pop("return", None)
    return tuple(_type_of(hint, f"{function.__name__}: {name}") for name, hint in hints.items())


def _type_of(hint: Any, name: str) -> Any:  # noqa: ANN401 (a type, an alias of one, or a NamedTuple)
    if get_origin(hint) is Annotated:
        return get_args(hint)[1]
    if get_origin(hint) is tuple:
        return _tuple_of([_type_of(member, name) for member in get_args(hint)], None)
    if hasattr(hint, "_fields"):
        members = get_type_hints(hint, include_extras=True)
        return _tuple_of([_type_of(member, f"{name}.{field}") for field, member in members.items()], hint)
    if hint not in _NUMBERS:
        raise TypeError(f"{name} is {hint}, which says no type of numba")
    return _NUMBERS[hint]


def _tuple_of(members: Sequence[Any], of: type | None) -> Any:  # noqa: ANN401
    return types.BaseTuple.from_types(tuple(members), of)  # type: ignore[no-untyped-call]
