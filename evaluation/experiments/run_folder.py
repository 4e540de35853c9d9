"""Run methods on a data set, and write their results folder, completely or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.datasets.identity import find_training_images
from evaluation.experiments.folds import folds_to_csv, groups_of
from evaluation.experiments.running import SceneMethod, evaluate, require_truths
from evaluation.experiments.suspicions import detect_other_conventions
from evaluation.learning.model_files import StoredMethod, TrainingRecord, scenes_sha256
from evaluation.methods.method import Method
from evaluation.metrics import ErrorKind
from evaluation.reports.run_page import (
    MAX_METHODS,
    chosen_images,
    developed_pictures,
    error_curves,
    error_planes,
    run_page,
)
from evaluation.reports.table_output import table_to_latex
from evaluation.results.files import ERRORS_FILE, errors_csv, run_json, several_lights_csv
from evaluation.results.method_records import describe_method
from evaluation.results.result import Result, Run, Subject, indistinct_methods
from evaluation.results.tables import lights_tables, statistics_rows, summary_table, table_to_csv
from evaluation.scene import MixedScene, Scene, SceneSet
from foundation.compiled import ordered_map
from foundation.errors import InputError, first_few
from foundation.files import write_atomic
from foundation.folders import atomic_folder
from foundation.plots import FigureForm
from foundation.version import software


def run_methods(
    data: SceneSet,
    methods: Sequence[Method | SceneMethod],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Run:
    """Return the estimates and errors of methods on a data set; `on_scene` is called for each finished image."""
    names = [method.name for method in methods]
    repeated = [name for index, name in enumerate(names) if name in names[:index]]
    if repeated:
        raise InputError(f"two methods have the name {repeated[0]!r}, expected different names; rename or omit one")
    truths = require_truths(data.scenes, methods)
    # Methods are recorded before they run, because a run may change their attributes.
    run = describe_run(data, (), [describe_method(method) for method in methods])
    records = {item.name: item.provenance for item in methods if isinstance(item, StoredMethod) and item.provenance}
    training_notes = [_training_note(name, record, data, run.data_sha256) for name, record in records.items()]
    results = evaluate(data.scenes, methods, workers, on_scene)
    convention_notes = detect_other_conventions(run.subject.images, truths, results)
    notes = (*filter(None, training_notes), *convention_notes, *indistinct_methods(results, data.truth_uncertainty_deg))
    return replace(run, results=results, notes=notes)


def write_run(
    run: Run,
    scenes: Sequence[Scene],
    folder: Path,
    metric: ErrorKind = "reproduction",
    workers: int = 1,
    figures: FigureForm | None = None,
) -> None:
    """Write results to a new results folder, with the figures of the report as files if `figures` is given."""
    with atomic_folder(folder, "the results") as partial:
        for name, text in _files(run, metric, _pictures(run, scenes, metric, workers)).items():
            write_atomic(partial / name, text)
        if figures:
            write_atomic(partial / f"curves.{figures}", error_curves(run.results, metric, figures))
            planes = error_planes(run.results, run.truths, metric, run.black_bodies, figures)
            write_atomic(partial / f"chromaticities.{figures}", planes)


def describe_run(
    data: SceneSet,
    results: tuple[Result, ...],
    methods: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any] | None = None,
    folds: npt.NDArray[np.int64] | None = None,
    notes: tuple[str, ...] = (),
) -> Run:
    """Return the results as a run; `folds`: (N,) int64, fold of each image, None without cross-validation."""
    return Run(
        subject=Subject(
            data.name,
            tuple(scene.name for scene in data.scenes),
            tuple(isinstance(scene, MixedScene) for scene in data.scenes),
            groups_of(data.scenes),
        ),
        layout=data.layout,
        location=data.location,
        treatment=data.treatment,
        data_sha256=scenes_sha256(data.scenes),
        truths=np.stack([scene.truth for scene in data.scenes]),
        results=results,
        methods=tuple(methods),
        settings={} if settings is None else settings,
        folds=folds,
        notes=notes,
        software=software(),
        truth_uncertainty_deg=data.truth_uncertainty_deg,
        black_bodies=data.black_bodies,
    )


def _training_note(name: str, record: TrainingRecord, data: SceneSet, sha256: str) -> str:
    if record.sha256 == sha256:
        return f"{name} was trained on these images: its errors are not valid for other images"
    shared = find_training_images(data.scenes, record.images)
    if shared:
        return (
            f"{name}: {len(shared)} of {len(data.scenes)} images were used for training (same name and ground "
            f"truth, or same source picture): {first_few(shared, 3)}; its errors are not valid for other images"
        )
    if record.data_name != data.name:
        return ""
    return (
        f"{name} was trained on {record.scenes} images of a data set of the same name; no image was identified as a "
        "training image by name and ground truth or by source picture"
    )


def _files(run: Run, metric: ErrorKind, pictures: Mapping[tuple[int, int], bytes]) -> dict[str, str]:
    subject, results = run.subject, run.results
    tables = [summary_table(subject, results, metric), *lights_tables(subject, results, metric)]
    pixels, regions = several_lights_csv(subject.images, results)
    content = {
        "data_set": {
            "name": subject.name,
            "layout": run.layout,
            "place": run.location,
            "images": len(subject.images),
            "images_under_several_lights": sum(subject.mixed),
            "groups": len(set(subject.groups or subject.images)),
            "sha256": run.data_sha256,
            **({} if run.truth_uncertainty_deg is None else {"truth_uncertainty_deg": run.truth_uncertainty_deg}),
        },
        "treatment": dict(run.treatment),
        "methods": [dict(method) for method in run.methods],
        "settings": dict(run.settings),
        "notes": [*run.notes, *tables[0].notes],
        "no_estimate": {result.method: int(result.guessed.sum()) for result in results},
        "software": run.software,
    }
    texts = {
        "run.json": run_json(content),
        "results.csv": table_to_csv(statistics_rows(subject, results)),
        ERRORS_FILE: errors_csv(subject.images, run.truths, results, subject.groups),
        "table.tex": "\n".join(map(table_to_latex, tables)),
        "report.html": run_page(run, metric, pictures),
    }
    if any(result.maps is not None for result in results):
        texts |= {"pixels.csv": pixels, "regions.csv": regions}
    if run.folds is not None:
        texts["folds.csv"] = folds_to_csv(subject.images, run.folds)
    return texts


def _pictures(run: Run, scenes: Sequence[Scene], metric: ErrorKind, workers: int) -> dict[tuple[int, int], bytes]:
    # JPEG files by indices of method and image. Each image is read once for all methods.
    methods_by_image: dict[int, list[int]] = {}
    for number, result in enumerate(run.results[:MAX_METHODS]):
        for image in sum(chosen_images(result, metric), ()):
            methods_by_image.setdefault(image, []).append(number)

    def develop(image: int) -> list[bytes]:
        estimates = [run.results[number].estimates[image] for number in methods_by_image[image]]
        return developed_pictures(scenes[image], estimates)

    files = ordered_map(develop, methods_by_image, workers)
    return {
        (number, image): file
        for (image, method_indices), image_files in zip(methods_by_image.items(), files, strict=True)
        for number, file in zip(method_indices, image_files, strict=True)
    }
