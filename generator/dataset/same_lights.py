"""Repeat the scenes and illuminants of a data set with the LUT of another camera.

- Illuminants of two LUTs are equal if the projectors showed the same codes; their numbers may differ. The user must
  ensure that the projectors are equal. Computed spectra must also have equal names, because different spectra may have
  one colour.
- Image number i of both data sets shows the same scene. A picture that the first data set skipped is skipped again.
- Weights of a mixture are relative to the exposures of its illuminants. All illuminants of a photographed LUT have one
  exposure, so weights are valid for both cameras. Computed spectra are exposed separately, so mixtures of them are
  refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foundation.errors import FormatError, InputError, first_few
from foundation.remote import is_remote
from generator.dataset.layouts import LAYOUTS, FileLayout
from generator.dataset.reader import Dataset
from generator.dataset.records import GROUND_TRUTH, Description, Light
from generator.lights.lighting import Lighting, Mixture, mixture_of, parse_mixture
from generator.masks.making import GivenMaskPlan, find_masks
from generator.pictures.random_scenes import RandomScene
from generator.pictures.sources import Preparation, Source, SourcePicture
from generator.stores import local_path

if TYPE_CHECKING:
    from calibration.table.lut import Lut


# Identity of an illuminant: its codes, and the name of a computed spectrum.
_LightKey = tuple[tuple[int, int, int], str | None]


@dataclass(frozen=True, eq=False)
class LightsOf:
    """The illuminants of each scene of a data set; a `LightChoice`."""

    dataset: str  # name of the data set
    table_sha256: str  # of its LUT
    sha256: str  # of its list of ground truths
    lights_each: int  # images of each scene, which is a picture or a crop
    lightings: tuple[Lighting, ...]  # of every planned image; arbitrary for images that were not made

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the scene at `position`."""
        return self.lightings[position * self.lights_each : (position + 1) * self.lights_each]

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`."""
        return {
            "choice": "lights of a dataset",
            "dataset": self.dataset,
            "ground_truth_sha256": self.sha256,
            "table_sha256": self.table_sha256,
        }


@dataclass(frozen=True, eq=False, slots=True)
class SamePicture:
    """A source picture that must equal the one used by another data set."""

    source: Source
    sha256: str | None

    @property
    def name(self) -> str:
        """Name of the picture in both data sets."""
        return self.source.name

    def read(self) -> SourcePicture:
        """Return the picture; raises InputError if it differs."""
        read = self.source.read()
        if self.sha256 is not None and read.sha256 != self.sha256:
            raise InputError(
                f"{self.name} differs from the picture of the first data set: its SHA-256 is {read.sha256}, expected "
                f"{self.sha256}; give the folder of the same pictures with --sources"
            )
        return read

    def to_json(self) -> dict[str, Any]:
        """Return name and preparation as plain values."""
        return self.source.to_json()


@dataclass(frozen=True, slots=True)
class MissingPicture:
    """A placeholder for a picture that the other data set could not read; it keeps the numbers of the images."""

    name: str

    def read(self) -> SourcePicture:
        """Raise FormatError."""
        raise FormatError(f"{self.name} was skipped in the first data set; it is skipped here too")

    def to_json(self) -> dict[str, Any]:
        """Return the name as plain values."""
        return {"left_out": self.name}


def preparation_of(description: Description) -> Preparation:
    """Return the preparation of the pictures of a data set."""
    crop = description.options.get("crop")
    return Preparation(
        max_side=description.options.get("max_side"),
        crop=None if crop is None else (crop[0], crop[1]),
        cover=bool(description.options.get("cover", False)),
        crop_at=description.options.get("crop_at"),
        # If this data set repeats another one, it was cropped with the seed of that one.
        seed=description.options.get("lights_of", {}).get("pictures_seed", description.seed),
        crops=int(description.options.get("crops", 1)),
    )


def lights_of(dataset: Dataset, lut: Lut) -> LightsOf:
    """Return the illuminants of a data set, with their numbers in another LUT."""
    description = dataset.description
    numbers = _same_lights(description.lights, lut, dataset.store.location)
    is_tinted = _is_tinted(dataset)
    if description.table.sha256 != lut.sha256:
        _require_single(dataset, is_tinted)
    masks = None if is_tinted else _masks_of(dataset)
    mixtures_by_label: dict[str, Mixture] = {}
    lightings: dict[int, Lighting] = {}
    for entry in dataset.entries:
        number = int(entry.image.partition(".")[0])
        labels = entry.lights[:1] if is_tinted else entry.lights
        mixtures = tuple(mixtures_by_label.setdefault(label, _renumbered(label, numbers)) for label in labels)
        lightings[number] = Lighting(mixtures, None if masks is None else masks.maker(number))
    first = next(iter(lightings.values()))
    return LightsOf(
        dataset=Path(dataset.store.location.rstrip("/")).name,
        table_sha256=description.table.sha256,
        sha256=hashlib.sha256(dataset.store.get(GROUND_TRUTH)).hexdigest(),
        lights_each=description.planned // _scene_count(dataset),
        lightings=tuple(lightings.get(number, first) for number in range(description.planned)),
    )


def scenes_of(dataset: Dataset, candidates: Sequence[Source]) -> tuple[Source, ...]:
    """Return the sources of a data set in its order."""
    by_name = {source.name: source for source in candidates}
    seed = dataset.description.seed
    sources: dict[int, Source] = {
        skipped.position: MissingPicture(skipped.name) for skipped in dataset.description.skipped
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
            f"{len(missing)} of the {len(dataset.sources)} pictures of {dataset.store.location} are missing: "
            f"{first_few(missing, 3)}; give the folder of its pictures with --sources"
        )
    return tuple(sources[position] for position in sorted(sources))


def _scene_count(dataset: Dataset) -> int:
    # The number of planned pictures, or of their crops.
    description = dataset.description
    return (description.sources + len(description.skipped)) * int(description.options.get("crops", 1))


def _is_tinted(dataset: Dataset) -> bool:
    # With a coloured fall-off, each image has one illuminant, which is listed twice: at both ends of the fall-off.
    gradient = dataset.description.options.get("variation", {}).get("gradient", {})
    return float(gradient.get("colour", 0)) > 0


def _same_lights(used: Sequence[Light], lut: Lut, location: str) -> dict[int, int]:
    by_codes: dict[_LightKey, int] = {}
    for illumination in lut.illuminations:
        by_codes.setdefault((illumination.colour, illumination.name), illumination.index)
    numbers: dict[int, int] = {}
    missing: list[str] = []
    for light in used:
        key = (light.codes, light.name)
        lut_light = lut.illuminations[light.illumination] if light.illumination < len(lut.illuminations) else None
        same = lut_light is not None and (lut_light.colour, lut_light.name) == key
        number = light.illumination if same else by_codes.get(key)
        if number is None:
            name_text = "" if light.name is None else f" called {light.name}"
            missing.append(f"number {light.illumination}{name_text} with codes {' '.join(map(str, light.codes))}")
        else:
            numbers[light.illumination] = number
    if missing:
        raise InputError(
            f"the LUT {lut.folder} lacks {len(missing)} of the {len(used)} illuminants of {location}: "
            f"{first_few(missing, 3)}; use a LUT of the same projector or spectra with the same list of illuminants"
        )
    return numbers


def _require_single(dataset: Dataset, is_tinted: bool) -> None:
    # Mixtures of spectra that were exposed separately are refused: their weights differ for another camera.
    if all(light.name is None for light in dataset.description.lights):
        return
    mixed = [
        entry.image
        for entry in dataset.entries
        if len(parse_mixture(entry.lights[0]).lights) > 1 or (len(entry.lights) > 1 and not is_tinted)
    ]
    if mixed:
        raise InputError(
            f"{len(mixed)} images of {dataset.store.location}, such as {mixed[0]}, mix spectra with separate "
            "exposures, expected single illuminants; make the first data set with --light, --random or --nearest"
        )


def _renumbered(label: str, numbers: Mapping[int, int]) -> Mixture:
    mixture = parse_mixture(label)
    if all(numbers[light] == light for light in mixture.lights):
        return mixture
    return mixture_of({numbers[light]: weight for light, weight in zip(mixture.lights, mixture.weights, strict=True)})


def _masks_of(dataset: Dataset) -> GivenMaskPlan | None:
    together = max(len(entry.lights) for entry in dataset.entries)
    if together == 1:
        return None
    location, layout = dataset.store.location, LAYOUTS[dataset.layout]
    folder = layout.folder("masks", dataset.description.parts) if isinstance(layout, FileLayout) else None
    if is_remote(location) or folder is None:
        remedy = "make it with --layout folder" if folder is None else "copy it to this machine"
        raise InputError(
            f"{location} has several illuminants in an image and the layout {dataset.layout}, expected masks in a "
            f"local folder; {remedy}"
        )
    return find_masks(local_path(location) / folder, together)
