"""`evaluate train`: train a method on a data set and write a model file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from evaluation.commands.options import Data, Read, argument, choose_learners, image_steps, open_data, thread_option
from foundation.clock import SystemClock
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError
from foundation.folders import require_free_file

# Names of the learners of this suite, for help texts.
LEARNERS_HELP = "regression-trees, smart-color-cat, color-beaver, log-chroma, kernel-ridge, convnet or constant-light"

HELP = f"""Train a method on every image of a data set and write a model file.

METHOD is {LEARNERS_HELP}.

Reads DATA in any layout of evaluate run. Writes MODEL.npz, a new file of plain arrays with a record of the training:
data set, number of images, hash of their names and ground truths, treatment of the images, settings, seed, software
and date. evaluate run DATA --method MODEL.npz uses it, for the same camera or another one; its tables include the
record. --adapt starts from such a file of the same method, trained for example on generated images, and adapts it to
DATA, for example few images of your camera.

{EXIT_CODES}
"""


@with_json("evaluate train")
def train(
    method: Annotated[str, argument("METHOD", f"One of {LEARNERS_HELP}.")],
    data: Data,
    *,
    out: Annotated[Path, option("MODEL.npz", "New model file; a missing folder is created.")],
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

    learners = choose_learners([method])
    if len(learners) != 1:
        raise InputError(f"METHOD is {method}, {len(learners)} methods, expected one for a model file; give one")
    (learner,) = learners
    if not isinstance(learner, FeatureLearner):
        raise InputError(
            f"{method} is your own class, expected a method of this suite for a model file; use evaluate cv {method} "
            f"{data} to train and test it, and let its fit write its own file to keep it"
        )
    if out.suffix != ".npz":
        raise InputError(f"--out is {out}, expected a name that ends in .npz, as evaluate run requires; rename it")
    require_free_file(out, "the model")
    require_installed(learner)
    base_model = None if adapt is None else load_model(adapt)
    if base_model is not None:
        if base_model.learner.key != learner.key:
            raise InputError(
                f"{adapt} is a model of {base_model.learner.key}, expected {method}; give a model of {method}"
            )
        # The settings of the base model apply, which may differ from the present defaults.
        learner = base_model.learner
    data_set = open_data(data, read)
    truths = truths_of(data_set.scenes)
    count = len(data_set.scenes)
    with image_steps(count) as step:
        (features,) = extract(data_set.scenes, [learner], workers or processor_count(), step)
        if base_model is None:
            fitted = fit_extracted(learner, features, truths, seed)
        else:
            fitted = adapting.adapt(base_model, adapting.fit_local(learner, features, truths, seed))
        base_record = base_model.provenance if base_model else None
        record = provenance_of(data_set, seed, SystemClock(), adapted_from=base_record)
        save_model(out, fitted, record)
    unused = sum(image_features is None for image_features in features)
    notes = [f"{unused} of {count} images have no usable pixel and were excluded from the training"] if unused else []
    output.add(model=out, method=learner.name, data_set=data_set.name, images=count, unused=unused, seed=seed)
    if isinstance(fitted.model, adapting.BlendedModel):
        share = float(fitted.model.share)
        output.add(adapted_from=adapt, share=share)
        notes.append(f"weights of the blend: {adapt} {share:.2f}, training on these images alone {1 - share:.2f}")
    print(f"{out}: {learner.name}, {record.description()}")
    show_notes(output, notes, data_set.treatment)
