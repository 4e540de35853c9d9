"""`evaluate train`: what a method learns from a data set, as a model file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from evaluation.commands.options import (
    Data,
    Read,
    argument,
    choose_learners,
    image_steps,
    open_data,
    thread_option,
)
from foundation.clock import SystemClock
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError
from foundation.folders import require_free_file

# The suite's own, for the help of commands.
LEARNERS_HELP = "regression-trees, smart-color-cat, color-beaver, log-chroma, kernel-ridge, convnet or constant-light"

HELP = f"""Train a method on every image of a data set and write what it has learned to a model file.

METHOD is {LEARNERS_HELP}.

Reads DATA, a data set of any layout that evaluate run reads. Writes MODEL.npz, a new file of plain arrays with the
story of their training: data set, number of images and a hash of their names and lights, what was done to the images,
settings, seed, software and date. evaluate run DATA --method MODEL.npz estimates with it, on the same camera or
another; the tables say what it was trained on. --adapt begins with such a file of the same method, trained elsewhere,
as on generated images, and adapts it to DATA, few images of the camera at hand.

{EXIT_CODES}
"""


@with_json("evaluate train")
def train(
    method: Annotated[str, argument("METHOD", f"One of {LEARNERS_HELP}.")],
    data: Data,
    *,
    out: Annotated[Path, option("MODEL.npz", "The new file to write the model to; its folder is made if missing.")],
    adapt: Annotated[
        Path | None, option("MODEL.npz", "Adapt this model of the same method to DATA, in place of training anew.")
    ] = None,
    seed: Annotated[int, option("N", "Of all that is random in the training.", min=0)] = 0,
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
        raise InputError(f"{method} are {len(learners)} methods, a model file holds one; name one")
    (learner,) = learners
    if not isinstance(learner, FeatureLearner):
        raise InputError(
            f"{method} is a class of your own, which a model file cannot hold: evaluate cv {method} {data} trains and "
            "evaluates it; let its fit write a file of its own if it is to be kept"
        )
    if out.suffix != ".npz":
        raise InputError(f"--out is {out}, expected a name that ends in .npz, by which evaluate run knows a model")
    require_free_file(out, "the model")
    require_installed(learner)
    known = None if adapt is None else load_model(adapt)
    if known is not None:
        if known.learner.key != learner.key:
            raise InputError(
                f"{adapt} is of {known.learner.key}, {method} was asked for; name a model of the same method"
            )
        # With the settings of then, which those of today need not be.
        learner = known.learner
    found = open_data(data, read)
    truths = truths_of(found.scenes)
    count = len(found.scenes)
    with image_steps(count) as step:
        (features,) = extract(found.scenes, [learner], workers or processor_count(), step)
        if known is None:
            fitted = fit_extracted(learner, features, truths, seed)
        else:
            fitted = adapting.adapt(known, adapting.learn_alone(learner, features, truths, seed))
        record = provenance_of(found, seed, SystemClock(), adapted_from=known.provenance if known else None)
        save_model(out, fitted, record)
    unused = sum(given is None for given in features)
    notes = [f"{unused} of {count} images have no usable pixel and were left out of the training"] if unused else []
    output.add(model=out, method=learner.name, data_set=found.name, images=count, unused=unused, seed=seed)
    if isinstance(fitted.model, adapting.BlendedModel):
        share = float(fitted.model.share)
        output.add(adapted_from=adapt, share=share)
        notes.append(f"{adapt} answers with a share of {share:.2f}, what these images teach alone with {1 - share:.2f}")
    print(f"{out}: {learner.name}, {record.sentence()}")
    show_notes(output, notes, found.treatment)
