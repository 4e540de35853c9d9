"""What the command says of rendering by colour: the matrix that it takes, and the work that is only done once."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from generator.dataset.production.plan import Plan
    from generator.rendering.matrices import ColourMatrix


def matrix_sentence(matrix: ColourMatrix, camera: str, *, chosen: bool) -> str:
    """Return which colour matrix is taken, where it comes from, and what to mind if the table gave it."""
    from generator.rendering.matrices import TABLE

    told = f"colour matrix: {matrix.name} ({matrix.source})"
    if matrix.name != TABLE:
        return told
    why = "" if chosen else f"that of {camera} is not known, so this one was fitted; "
    return (
        f"{told}; {why}if the print's colours were not managed, its faults are in the matrix as well: --matrix NAME "
        "or FILE takes that of a camera"
    )


def cells_sentences(plan: Plan, shards: Iterable[int]) -> tuple[str, ...]:
    """Return a line about lights whose cells are yet to be found while some shards of a plan are made, if there are."""
    if plan.options.rendering != "colorimetric":
        return ()
    from generator.dataset.production.photographing import rendering_of
    from generator.rendering.colorimetric import lights_to_find

    size = plan.options.shard_images
    images = (number for shard in shards for number in range(shard * size, shard * size + plan.images_of(shard)))
    scenes = groupby(images, lambda image: image // plan.choice.lights_each)
    lightings = (
        lighting
        for scene, shown in scenes
        for lightings in (plan.choice.lightings_of(scene),)
        for lighting in (lightings[image % plan.choice.lights_each] for image in shown)
    )
    found = len(lights_to_find(rendering_of(plan.lut, plan.options), lightings))
    if not found:
        return ()
    return (
        f"finding the cells of {found} light{'' if found == 1 else 's'} on the way, once: they are kept for the next "
        "time; until then the time left is shown too long",
    )
