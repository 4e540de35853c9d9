"""The scenes of a dataset under the same physical lights, for the table of another camera.

Rules that hold inside:

- Two tables have a light in common if both were photographed while the projector showed the same codes; its number may
  differ. That the projector was the same, or an equal one, is for the user to know. Lights of computed tables that have
  spectra of their own must have the same name besides: lamps of one colour are not one light.
- Image number i of the second dataset shows what image number i of the first shows. A picture that the first could not
  read is left out of the second, and its numbers stay free.
- Weights of a mixture are shares of the lights as they were photographed. In a photographed table all lights have one
  exposure, so they are the same shares of the same lights for both cameras. Spectra are exposed each by itself, and
  mixtures of them are refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foundation.errors import FormatError, InputError, first_few
from generator.dataset.layouts import LAYOUTS, FileLayout
from generator.dataset.reader import Dataset
from generator.dataset.records import GROUND_TRUTH, Description, Light
from generator.lights.lighting import Lighting, Mixture, mixture_of, parse_mixture
from generator.masks.making import GivenMaskPlan, find_masks
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import Preparation, Source, SourcePicture
from generator.stores import is_remote, local_path

if TYPE_CHECKING:
    from calibration.table.lut import Lut


# What a light is known by: codes, and its name if it has a spectrum of its own.
_Shown = tuple[tuple[int, int, int], str | None]


@dataclass(frozen=True, eq=False)
class LightsOf:
    """The lights of each scene of a dataset; a `LightChoice`.

    - `dataset`: name of the dataset.
    - `table_sha256`, `sha256`: of its table, and of its list of ground truths.
    - `lights_each`: images for each scene: for each picture, or for each crop of it.
    - `lightings`: those of every planned image; of an image that was not made, those of another.
    """

    dataset: str
    table_sha256: str
    sha256: str
    lights_each: int
    lightings: tuple[Lighting, ...]

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the scene at `position`."""
        return self.lightings[position * self.lights_each : (position + 1) * self.lights_each]

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {
            "choice": "lights of a dataset",
            "dataset": self.dataset,
            "ground_truth_sha256": self.sha256,
            "table_sha256": self.table_sha256,
        }


@dataclass(frozen=True, eq=False, slots=True)
class SamePicture:
    """A source picture that must be the one that another dataset was made of."""

    source: Source
    sha256: str | None

    @property
    def name(self) -> str:
        """The picture's name in both datasets."""
        return self.source.name

    def read(self) -> SourcePicture:
        """Return the picture."""
        read = self.source.read()
        if self.sha256 is not None and read.sha256 != self.sha256:
            raise InputError(
                f"{self.name} is not the picture that the dataset was made of: its SHA-256 is {read.sha256}, expected "
                f"{self.sha256}; name the folder of the same pictures with --sources"
            )
        return read

    def to_json(self) -> dict[str, Any]:
        """Return its name and its preparation as a JSON object."""
        return self.source.to_json()


@dataclass(frozen=True, slots=True)
class LeftOutPicture:
    """A picture that the other dataset could not read: it takes its place in the list, so that numbers stay."""

    name: str

    def read(self) -> SourcePicture:
        """Raise a FormatError that says that it is left out."""
        raise FormatError(f"{self.name} is not in the dataset whose lights are taken; it is left out here as well")

    def to_json(self) -> dict[str, Any]:
        """Return its name as a JSON object."""
        return {"left_out": self.name}


def preparation_of(made: Description) -> Preparation:
    """Return how the pictures of a dataset were prepared."""
    crop = made.options.get("crop")
    return Preparation(
        max_side=made.options.get("max_side"),
        crop=None if crop is None else (crop[0], crop[1]),
        cover=bool(made.options.get("cover", False)),
        crop_at=made.options.get("crop_at"),
        # Scenes that another dataset had first are cut where its seed said.
        seed=made.options.get("lights_of", {}).get("pictures_seed", made.seed),
        crops=int(made.options.get("crops", 1)),
    )


def lights_of(dataset: Dataset, lut: Lut) -> LightsOf:
    """Return the lights of a dataset as lights of another table."""
    made = dataset.description
    numbers = _same_lights(made.lights, lut, dataset.store.place)
    tinted = _is_tinted(dataset)
    if made.table.sha256 != lut.sha256:
        _require_single(dataset, tinted)
    masks = None if tinted else _masks_of(dataset)
    known: dict[str, Mixture] = {}
    lightings: dict[int, Lighting] = {}
    for entry in dataset.entries:
        number = int(entry.image.partition(".")[0])
        labels = entry.lights[:1] if tinted else entry.lights
        mixtures = tuple(known.setdefault(label, _renumbered(label, numbers)) for label in labels)
        lightings[number] = Lighting(mixtures, None if masks is None else masks.maker(number))
    first = next(iter(lightings.values()))
    return LightsOf(
        dataset=Path(dataset.store.place.rstrip("/")).name,
        table_sha256=made.table.sha256,
        sha256=hashlib.sha256(dataset.store.get(GROUND_TRUTH)).hexdigest(),
        lights_each=made.planned // _scenes(dataset),
        lightings=tuple(lightings.get(number, first) for number in range(made.planned)),
    )


def scenes_of(dataset: Dataset, found: Sequence[Source]) -> tuple[Source, ...]:
    """Return the sources of a dataset in its order."""
    by_name = {source.name: source for source in found}
    seed = dataset.description.seed
    sources: dict[int, Source] = {
        skipped.position: LeftOutPicture(skipped.name) for skipped in dataset.description.skipped
    }
    missing: list[str] = []
    for record in dataset.sources:
        if record.sha256 is None and record.name.startswith("random-"):
            number = int(record.name.removeprefix("random-"))
            sources[record.position] = RandomScene(number, record.width, record.height, seed)
        elif record.name in by_name:
            sources[record.position] = SamePicture(by_name[record.name], record.sha256)
        else:
            missing.append(record.name)
    if missing:
        raise InputError(
            f"{len(missing)} of the {len(dataset.sources)} pictures of {dataset.store.place} are not found: "
            f"{first_few(missing, 3)}; name the folder that it was made of with --sources"
        )
    return tuple(sources[position] for position in sorted(sources))


def _scenes(dataset: Dataset) -> int:
    """Return of how many scenes the images of a dataset were to be: its pictures, or all crops of them."""
    made = dataset.description
    return (made.sources + len(made.skipped)) * int(made.options.get("crops", 1))


def _is_tinted(dataset: Dataset) -> bool:
    """Return whether the light of each image falls off with a tint: it is one light, listed with its two ends."""
    gradient = dataset.description.options.get("variation", {}).get("gradient", {})
    return float(gradient.get("colour", 0)) > 0


def _same_lights(used: Sequence[Light], lut: Lut, place: str) -> dict[int, int]:
    by_codes: dict[_Shown, int] = {}
    for shown in lut.illuminations:
        by_codes.setdefault((shown.colour, shown.name), shown.index)
    numbers: dict[int, int] = {}
    missing: list[str] = []
    for light in used:
        key = (light.codes, light.name)
        found = lut.illuminations[light.illumination] if light.illumination < len(lut.illuminations) else None
        same = found is not None and (found.colour, found.name) == key
        number = light.illumination if same else by_codes.get(key)
        if number is None:
            named = "" if light.name is None else f" called {light.name}"
            missing.append(f"number {light.illumination}{named} of codes {' '.join(map(str, light.codes))}")
        else:
            numbers[light.illumination] = number
    if missing:
        raise InputError(
            f"the table {lut.folder} lacks {len(missing)} of the {len(used)} lights of {place}: {first_few(missing, 3)}"
            "; take a table of the same projector, or of the same spectra, and the same list of lights"
        )
    return numbers


def _require_single(dataset: Dataset, tinted: bool) -> None:
    """Refuse mixtures of lights that were each exposed by itself: elsewhere their weights mean another mixture."""
    if all(light.name is None for light in dataset.description.lights):
        return
    mixed = [
        entry.image
        for entry in dataset.entries
        if len(parse_mixture(entry.lights[0]).lights) > 1 or (len(entry.lights) > 1 and not tinted)
    ]
    if mixed:
        raise InputError(
            f"{len(mixed)} images of {dataset.store.place}, such as {mixed[0]}, are under several spectra at once, of "
            "which each was exposed by itself for its camera, so that their proportion is not known; make the first "
            "dataset under single lights (--light, --random, --nearest)"
        )


def _renumbered(label: str, numbers: Mapping[int, int]) -> Mixture:
    mixture = parse_mixture(label)
    if all(numbers[light] == light for light in mixture.lights):
        return mixture
    return mixture_of({numbers[light]: weight for light, weight in zip(mixture.lights, mixture.weights, strict=True)})


def _masks_of(dataset: Dataset) -> GivenMaskPlan | None:
    """Return the masks of a dataset; None where one light falls on each image."""
    together = max(len(entry.lights) for entry in dataset.entries)
    if together == 1:
        return None
    place, layout = dataset.store.place, LAYOUTS[dataset.layout]
    folder = layout.folder("masks", dataset.description.parts) if isinstance(layout, FileLayout) else None
    if is_remote(place) or folder is None:
        remedy = "make it in the layout folder" if folder is None else "copy it here"
        raise InputError(
            f"several lights fall on the images of {place}, whose masks are needed in a folder of this machine, "
            f"and it has the layout {dataset.layout}; {remedy}"
        )
    return find_masks(local_path(place) / folder, together)
