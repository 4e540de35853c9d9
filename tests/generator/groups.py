"""Keywords of `generate_dataset` from fields of its option groups."""

from __future__ import annotations

import dataclasses
from typing import Any

from generator.dataset.making import Workers
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import Callbacks


def grouped(**fields: Any) -> dict[str, Any]:
    """Return the keywords of `generate_dataset` for fields of its groups and for its own parameters."""
    groups: dict[str, Any] = {}
    if "workers" in fields:
        fields["count"] = fields.pop("workers")
    for name, group in (("options", DatasetOptions), ("workers", Workers), ("callbacks", Callbacks)):
        names = {field.name for field in dataclasses.fields(group)} & fields.keys()
        groups[name] = group(**{field: fields.pop(field) for field in names})
    return groups | fields
