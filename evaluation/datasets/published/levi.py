"""Read LEVI, 700 night images of two cameras, and the sets that its authors publish in the same layout (NCC, Gehler).

    img/1.png …    linear camera RGB, 12 or 14 bits in 16-bit files
    msk/1.png …    not 0 on the colour chart
    gt.mat         gts, gt or real_rgb (N, 3): row n is the ground truth of image n

Y.-K. Lee et al., "RL-AWB: deep reinforcement learning for auto white balance correction in low-light night-time
scenes", 2026 (arXiv:2601.05249). All rules are from `RGB_estimation` in utils/Algorithm.py of their program,
github.com/BrianChen1120/RL-AWB. The program subtracts no black level. It excludes pixels whose mask is above 0, and
pixels with a channel of 0.95 m or more, where m is the largest value of the image. It also excludes the neighbours of
these clipped pixels and reduces the images; this reader does neither. Not verified against a real copy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from evaluation.datasets.files import Folder, Mask, check_light, match_images, read_mask
from evaluation.datasets.options import DataOptions, level_note
from evaluation.datasets.published.cube import Peaks, PeakScene
from evaluation.datasets.published.matlab import numeric_table, read_mat
from evaluation.scene import Image, SceneSet
from foundation.errors import FormatError, first_few

_TRUTH_FILE = "gt.mat"
_VARIABLES = ("gts", "gt", "real_rgb")  # in the order in which the authors' program looks for them
_CLIPPED_SHARE = 0.95  # of the largest value of an image
_NAMES: Final = {700: "LEVI", 513: "NCC", 559: "Gehler (RL-AWB)"}  # by number of images (dataset/README.md)
# Largest masked fraction of an image. Charts cover a few per cent; an inverted mask covers nearly the whole image.
_LARGEST_MASK = 0.5


@dataclass(frozen=True, slots=True)
class NightScene(PeakScene):
    """Image with a mask of its chart."""

    mask_path: str = ""

    @property
    def saturation(self) -> float:
        """Value from which a pixel is clipped, minus black level."""
        white = _CLIPPED_SHARE * self.peaks.value(self.path) if self.white is None else self.white
        return white - self.black

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool for an image (H, W, 3), True on the chart."""
        mask = read_mask(self.mask_path)
        if mask.shape != image.shape[:2]:
            raise FormatError(
                f"{self.mask_path} has {mask.shape[1]} × {mask.shape[0]} px, expected {image.shape[1]} × "
                f"{image.shape[0]} like {self.path}; restore it"
            )
        if mask.mean() > _LARGEST_MASK:
            raise FormatError(
                f"{self.mask_path} is not 0 in {mask.mean():.0%} of the image, expected values above 0 only on the "
                "chart; invert the masks"
            )
        return mask


def is_levi(folder: Folder) -> bool:
    """Return True if a folder has gt.mat, img and msk."""
    return folder.has(_TRUTH_FILE) and folder.folders.keys() >= {"img", "msk"}


def open_levi(location: str, options: DataOptions, scanned_folder: Folder | None = None) -> SceneSet:
    """Return the images of the data set; they are read on use."""
    folder = scanned_folder or Folder(Path(location))
    if not is_levi(folder):
        raise FormatError(f"{location} has not {_TRUTH_FILE}, img and msk, expected LEVI; unpack it there")
    path = folder.path / _TRUTH_FILE
    content = read_mat(path)
    variable = next((name for name in _VARIABLES if name in content), _VARIABLES[0])
    lights = numeric_table(content, variable, path, 3)
    images, masks = folder.folders["img"].images(), folder.folders["msk"].images()
    names = [str(number) for number in range(1, len(lights) + 1)]
    source = f"{variable} of {_TRUTH_FILE}"
    indices, note = match_images(names, images, source, folder.folders["img"].path, options.partial)
    used = [names[index] for index in indices]
    missing = [name for name in used if name not in masks]
    if missing:
        raise FormatError(
            f"{folder.folders['msk'].path} lacks the masks of {len(missing)} images ({first_few(missing)}), expected "
            "one for each image; restore them"
        )
    black, peaks = options.black or 0.0, Peaks()
    return SceneSet(
        name=_NAMES.get(len(lights), folder.path.resolve().name),
        layout="levi",
        location=location,
        scenes=tuple(
            NightScene(
                f"{name}.png",
                images[name],
                check_light(lights[int(name) - 1].tolist(), f"{path}: {variable}, row {name}"),
                black,
                options.saturation,
                peaks,
                masks[name],
            )
            for name in used
        ),
        treatment={
            "images": note,
            "black level": level_note(options.black, "0: the authors' program subtracts none (RL-AWB)"),
            "saturation": level_note(
                options.saturation,
                f"from {_CLIPPED_SHARE:g} m, m the largest value in any channel of the image (RL-AWB)",
            ),
            "mask": "the colour chart: pixels of msk above 0",
            "ground truth": source,
        },
    )
