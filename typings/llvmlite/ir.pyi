"""The part of llvmlite that the kernels are written with; values and builders are left untyped."""

from typing import Any

Undefined: Any

def Constant(kind: Any, value: Any) -> Any: ...  # noqa: N802
def DoubleType() -> Any: ...  # noqa: N802
def FloatType() -> Any: ...  # noqa: N802
def Function(module: Any, kind: Any, name: str) -> Any: ...  # noqa: N802
def FunctionType(result: Any, arguments: Any) -> Any: ...  # noqa: N802
def IntType(bits: int) -> Any: ...  # noqa: N802
def VectorType(element: Any, count: int) -> Any: ...  # noqa: N802
def VoidType() -> Any: ...  # noqa: N802
