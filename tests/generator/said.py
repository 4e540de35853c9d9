"""Results of calls that may be refused, for pinned tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foundation.errors import CropError


def said(call: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """Return the result of a call, or a record of its refusal."""
    try:
        return call(*arguments, **keywords)
    except CropError:
        return {"refused": 1}
