"""The folders that Fast Fourier Color Constancy (FFCC) trains on: a linear thumbnail and a text file for each image.

    FOLDER/…/000001.png      linear thumbnail, black removed; 8 or 16 bits
    FOLDER/…/000001.txt      red, green, blue of the light, a line each

README.md of github.com/google/ffcc, "Preparation and folder structure"; folders below are searched as there. Its own
preparation (internal/ReadImage.m) leaves out charts and clipped pixels before it averages, by making them zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from evaluation.datasets.files import Folder, PaintedScene, decode_image
from evaluation.datasets.options import DataOptions, stated
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, first_few

_DEPTH = 4  # Folders below the one given that are searched: more than the toolbox's own data sets have
_SAMPLE = 100  # Names of a folder that are looked at to tell the layout


@dataclass(frozen=True, slots=True)
class ThumbnailScene(PaintedScene):
    """A linear thumbnail; `white` is None unless the user gives it."""

    def decoded(self) -> Image:
        """Return the thumbnail (H, W, 3) as the file's numbers are, of 8 bits too."""
        return decode_image(self.path, eight_bits=True)


def is_ffcc(folder: Folder) -> bool:
    """Return whether a folder looks like FFCC's: in it or below are a NAME.png and its NAME.txt."""
    for place in folder.within(1):
        files = place.files
        for name in islice((name for name in files if name.lower().endswith(".png")), _SAMPLE):
            if place.has(f"{name[:-4]}.txt"):
                return True
    return False


def open_ffcc(place: str, options: DataOptions, listed: Folder | None = None) -> SceneSet:
    """Return the thumbnails of a folder and of those below it; thumbnails and lights are read when they are used."""
    folder = listed or Folder(Path(place))
    black = 0.0 if options.black is None else options.black
    scenes: list[ThumbnailScene] = []
    without: list[str] = []
    alone: list[str] = []
    for below in folder.within(_DEPTH):
        images = below.images()
        texts = {name[:-4] for name in below.files if name.lower().endswith(".txt")}
        without.extend(images[name] for name in images if name not in texts)
        if images:
            alone.extend(str(below.path / f"{name}.txt") for name in sorted(texts.difference(images)))
        prefix = below.path.relative_to(folder.path).as_posix()
        prefix = "" if prefix == "." else f"{prefix}/"
        scenes.extend(
            ThumbnailScene(f"{prefix}{name}.png", path, f"{path[:-4]}.txt", black, options.saturation)
            for name, path in images.items()
            if name in texts
        )
    if without or (alone and not options.partial) or not scenes:
        raise FormatError(
            f"{place} has {len(scenes)} thumbnails with a light, {len(without)} without "
            f"({first_few(without) or 'none'}) and {len(alone)} text files without a thumbnail "
            f"({first_few(alone) or 'none'}), expected NAME.png with NAME.txt; complete or remove them"
        )
    return SceneSet(
        name=folder.path.resolve().name,
        layout="ffcc",
        location=place,
        scenes=tuple(scenes),
        treatment={
            "images": str(len(scenes)),
            "black level": stated(options.black, "0: removed when the thumbnails were made (README.md of FFCC)"),
            "saturation": stated(options.saturation, "none: averaged pixels do not show what was clipped"),
            "mask": "pixels that are zero in every channel",
            "ground truth": "the text file beside each thumbnail",
        },
    )
