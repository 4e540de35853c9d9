"""Training records for tests."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from evaluation.learning.model_files import TrainingRecord, provenance_of
from evaluation.scene import Scene, SceneSet


class Noon:
    """A clock that always returns the same time."""

    def now(self) -> datetime:
        return datetime(2026, 11, 22, 12, tzinfo=UTC)

    def monotonic(self) -> float:
        return 0.0

    def sleep(self, seconds: float) -> None:
        raise AssertionError(seconds)


def story(scenes: Sequence[Scene], name: str = "made up") -> TrainingRecord:
    data = SceneSet(name, "memory", "nowhere", tuple(scenes), {"mask": "none"})
    return provenance_of(data, seed=3, clock=Noon())
