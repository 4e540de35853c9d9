"""What a call gives, or why it is refused, to be pinned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foundation.errors import CropError


def said(call: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """Return what a call gives, or the sentence that refuses it."""
    try:
        return call(*given, **named)
    except CropError as error:
        return str(error)
