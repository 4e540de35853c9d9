"""A run as a value: what was evaluated, how, and what came out; everything that a results folder is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.results.result import Result
from evaluation.results.summary_tables import Subject


@dataclass(frozen=True, eq=False)
class Run:
    """Methods on a data set, and their results.

    - `subject`: the data set's name and its images.
    - `layout`, `place`, `treatment`: see `scene.SceneSet`.
    - `data_sha256`: of the images' names and ground truths; see `learning.model_files.scenes_sha256`.
    - `truths`: (N, 3) float64, camera RGB of any length.
    - `results`: one a method.
    - `methods`: A JSON object each; see `method_records.describe_method`.
    - `settings`: what else the results depend on, such as a seed: JSON.
    - `folds`: (N,) int64, the fold of each image, where the methods were cross-validated; else None.
    - `notes`: sentences that belong beside the results.
    - `software`: name and version of what made them.
    """

    subject: Subject
    layout: str
    place: str
    treatment: Mapping[str, str]
    data_sha256: str
    truths: npt.NDArray[np.float64]
    results: tuple[Result, ...]
    methods: tuple[Mapping[str, Any], ...]
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    folds: npt.NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    software: str = ""
