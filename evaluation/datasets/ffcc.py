"""Read training folders of Fast Fourier Color Constancy (FFCC): a linear thumbnail and a text file for each image.

    FOLDER/…/000001.png      linear thumbnail, black level subtracted; 8 or 16 bits
    FOLDER/…/000001.txt      red, green and blue of the illuminant, one per line

Source: README.md of github.com/google/ffcc, "Preparation and folder structure". Subfolders are searched too. Charts
and clipped pixels are zero, because FFCC (internal/ReadImage.m) sets them to zero before it reduces an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from evaluation.datasets.files import Folder, ZeroMaskedScene, decode_image
from evaluation.datasets.options import DataOptions, level_note
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, first_few

_SEARCH_DEPTH = 4  # levels of subfolders that are searched; data sets of FFCC have fewer
_SAMPLED_NAMES = 100  # thumbnails of a folder that are checked to recognise the layout


@dataclass(frozen=True, slots=True)
class ThumbnailScene(ZeroMaskedScene):
    """A linear thumbnail; `white` is None unless the user gives it."""

    def decode(self) -> Image:
        """Return the unchanged values of the file, (H, W, 3), 8 or 16 bits."""
        return decode_image(self.path, eight_bits=True)


def is_ffcc(folder: Folder) -> bool:
    """Return True if the folder or a direct subfolder has a NAME.png with its NAME.txt."""
    for child in folder.within(1):
        names = child.files
        for name in islice((name for name in names if name.lower().endswith(".png")), _SAMPLED_NAMES):
            if child.has(f"{name[:-4]}.txt") or child.has(f"{name[:-4]}.TXT"):
                return True
    return False


def open_ffcc(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the thumbnails of a folder and its subfolders; images and ground truths are read on use."""
    folder = scanned_folder or Folder(Path(location))
    black = 0.0 if options.black is None else options.black
    scenes: list[ThumbnailScene] = []
    lone_thumbnails: list[str] = []
    lone_texts: list[str] = []
    for child in folder.within(_SEARCH_DEPTH):
        images = child.images()
        texts = {name[:-4]: str(child.path / name) for name in child.files if name.lower().endswith(".txt")}
        lone_thumbnails.extend(images[name] for name in images if name not in texts)
        if images:
            lone_texts.extend(texts[name] for name in sorted(texts.keys() - images))
        prefix = child.path.relative_to(folder.path).as_posix()
        prefix = "" if prefix == "." else f"{prefix}/"
        scenes.extend(
            ThumbnailScene(f"{prefix}{name}.png", path, texts[name], black, options.saturation)
            for name, path in images.items()
            if name in texts
        )
    if lone_thumbnails or (lone_texts and not options.partial) or not scenes:
        raise FormatError(
            f"{location} has {len(scenes)} thumbnails with a ground truth, {len(lone_thumbnails)} without "
            f"({first_few(lone_thumbnails) or 'none'}) and {len(lone_texts)} text files without a thumbnail "
            f"({first_few(lone_texts) or 'none'}); expected NAME.png with NAME.txt; complete or remove them"
        )
    return SceneSet(
        name=folder.path.resolve().name,
        layout="ffcc",
        location=location,
        scenes=tuple(scenes),
        treatment={
            "images": str(len(scenes)),
            "black level": level_note(options.black, "0: subtracted from the thumbnails (README.md of FFCC)"),
            "saturation": level_note(options.saturation, "none: clipping cannot be detected in averaged pixels"),
            "mask": "pixels that are zero in every channel",
            "ground truth": "the text file of each thumbnail",
        },
    )
