"""`evaluate train`: train a method on a data set and write a model file."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from evaluation.commands.options import (
    Data,
    Read,
    argument,
    choose_learners,
    choose_without_constant,
    image_steps,
    open_data,
    split_names,
    thread_option,
)
from foundation.clock import SystemClock
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError
from foundation.folders import atomic_folder, require_free, require_free_file

# Names of the learners of this suite, for help texts.
LEARNERS_HELP = "regression-trees, smart-color-cat, color-beaver, log-chroma, kernel-ridge, convnet or constant-light"

HELP = f"""Train methods on every image of a data set and write model files.

METHOD is {LEARNERS_HELP}, or all. Separate several methods by commas; --out is then a new folder for METHOD.npz of each
method.

Reads DATA in any layout of evaluate run. Writes MODEL.npz, a new file of plain arrays with a record of the training:
data set, number of images, hash of their names and ground truths, treatment of the images, settings, seed, software
and date. evaluate run DATA --method MODEL.npz uses it, for the same camera or another one; its tables include the
record. --adapt starts from such a file of the same method, trained for example on generated images, and adapts it to
DATA, for example few images of your camera.

{EXIT_CODES}
"""


@with_json("evaluate train")
def train(
    method: Annotated[str, argument("METHOD", f"{LEARNERS_HELP} or all; several separated by commas.")],
    data: Data,
    *,
    out: Annotated[
        Path,
        option("MODEL.npz|FOLDER", "New model file; a missing folder is created. For several methods, a new folder."),
    ],
    adapt: Annotated[
        Path | None, option("MODEL.npz", "Adapt this model of the same method to DATA instead of training a new one.")
    ] = None,
    seed: Annotated[int, option("N", "Seed of the training.", min=0)] = 0,
    workers: Annotated[int | None, thread_option(" that read images; the model does not depend on it")] = None,
    read: Read = None,
    output: JsonOutput,
) -> None:
    """Train a method on a data set."""
    from evaluation.learning import adapting
    from evaluation.learning.feature_learner import FeatureLearner, extract, fit_extracted, require_installed, truths_of
    from evaluation.learning.model_files import load_model, provenance_of, save_model
    from evaluation.reports.table_output import show_notes

    # `all` omits learners that need a library that is not installed, as in evaluate cv.
    names = split_names([method])
    chosen, notes = choose_learners(names), list[str]()
    if "all" in map(str.lower, names):
        chosen, notes = choose_without_constant(names)
    if not chosen:
        raise InputError(f"METHOD is {method!r}, 0 methods, expected at least 1; name one")
    learners = [learner for learner in chosen if isinstance(learner, FeatureLearner)]
    if len(learners) < len(chosen):
        raise InputError(
            f"{method} includes your own class, expected only methods of this suite; use evaluate cv {method} "
            f"{data} to train and test your class, and save its model in its method fit"
        )
    is_single = len(learners) == 1
    if is_single != (out.suffix == ".npz"):
        expected = "a name that ends in .npz, as evaluate run requires" if is_single else "a folder for several models"
        raise InputError(f"--out is {out}, expected {expected}; rename it")
    if is_single:
        require_free_file(out, "the model")
    else:
        require_free(out, "the models")
    for learner in learners:
        require_installed(learner)
    base_model = None if adapt is None else load_model(adapt)
    if base_model is not None:
        if [base_model.learner.key] != [learner.key for learner in learners]:
            raise InputError(
                f"{adapt} is a model of {base_model.learner.key}, expected {method}; give a model of {method}"
            )
        # The settings of the base model are used. They may differ from the present defaults.
        learners = [base_model.learner]
    data_set = open_data(data, read)
    truths = truths_of(data_set.scenes)
    count = len(data_set.scenes)
    base_record = base_model.provenance if base_model else None
    with image_steps(count) as step, nullcontext(out) if is_single else atomic_folder(out, "the models") as folder:
        extracted = extract(data_set.scenes, learners, workers or processor_count(), step)
        record = provenance_of(data_set, seed, SystemClock(), adapted_from=base_record)
        shares: dict[str, float] = {}
        for learner, features in zip(learners, extracted, strict=True):
            if base_model is None:
                fitted = fit_extracted(learner, features, truths, seed)
            else:
                fitted = adapting.adapt(base_model, adapting.fit_local(learner, features, truths, seed))
            save_model(out if is_single else folder / f"{learner.key}.npz", fitted, record)
            if isinstance(fitted.model, adapting.BlendedModel):
                shares[learner.key] = float(fitted.model.share)
    for learner, features in zip(learners, extracted, strict=True):
        path = out if is_single else out / f"{learner.key}.npz"
        unused = sum(image_features is None for image_features in features)
        if unused:
            notes.append(f"{unused} of {count} images have no usable pixel and were excluded from the training")
        values: dict[str, Any] = {
            "model": path, "method": learner.name, "data_set": data_set.name, "images": count, "unused": unused,
            "seed": seed,
        }  # fmt: skip
        if learner.key in shares:
            share = shares[learner.key]
            values |= {"adapted_from": adapt, "share": share}
            notes.append(f"weights of the blend: {adapt} {share:.2f}, training on these images alone {1 - share:.2f}")
        if is_single:
            output.add(**values)
        else:
            output.append("models", values)
        print(f"{path}: {learner.name}, {record.description()}")
    show_notes(output, list(dict.fromkeys(notes)), data_set.treatment)
