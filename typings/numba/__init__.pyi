"""The part of numba that the suite uses, typed as what a compiled function means: the function it was made from."""

from collections.abc import Callable
from typing import Any, TypeVar

_F = TypeVar("_F", bound=Callable[..., Any])

def njit(
    *,
    cache: bool = ...,
    error_model: str = ...,
    fastmath: bool = ...,
    inline: str = ...,
    nogil: bool = ...,
    parallel: bool = ...,
) -> Callable[[_F], _F]: ...
def uint8(value: Any) -> Any: ...
def uint16(value: Any) -> Any: ...
def uint32(value: Any) -> Any: ...
def uint64(value: Any) -> Any: ...
