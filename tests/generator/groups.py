"""The option groups of `generate_dataset` from plain keywords."""

from __future__ import annotations

import dataclasses
from typing import Any

from generator.dataset.making import Workers
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import Callbacks


def grouped(**wishes: Any) -> dict[str, Any]:
    """Return the keywords of `generate_dataset` for `wishes`: fields of its groups, or its own."""
    groups: dict[str, Any] = {}
    if "workers" in wishes:
        wishes["count"] = wishes.pop("workers")
    for name, group in (("options", DatasetOptions), ("workers", Workers), ("callbacks", Callbacks)):
        names = {field.name for field in dataclasses.fields(group)} & wishes.keys()
        groups[name] = group(**{field: wishes.pop(field) for field in names})
    return groups | wishes
