"""The result of a call or its refusal, to be pinned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foundation.errors import CropError


def said(call: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """Return the result of a call, or that it was refused."""
    try:
        return call(*given, **named)
    except CropError:
        return {"refused": 1}
