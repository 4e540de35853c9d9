"""The part of numba's cache of machine code that ours is made of; what it compiles is left untyped."""

from types import FunctionType
from typing import Any

class FunctionCache:
    _impl: Any
    _py_func: FunctionType
    _cache_path: str

    def __init__(self, function: FunctionType) -> None: ...
    def load_overload(self, sig: Any, target_context: Any) -> Any: ...
    def save_overload(self, sig: Any, data: Any) -> None: ...
    def _index_key(self, sig: Any, codegen: Any) -> Any: ...
