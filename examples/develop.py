"""Develop the raw images of a data set to sRGB source pictures with white balance by their ground truths.

Usage: python examples/develop.py DATA FOLDER [--matrix CAMERA] [--side PX]. DATA is any data set that `evaluate` reads.
The pictures are PNG files with the names of the images. The method is described in
evaluation/experiments/paper/material.py.
"""

from __future__ import annotations

import argparse
from pathlib import Path, PurePosixPath

import cv2

from evaluation.datasets import open_scenes
from evaluation.experiments.paper.material import ScaledSource, develop_sources
from generator.rendering.matrices import choose_matrix


def main() -> None:
    """Write a picture for each image."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="data set")
    parser.add_argument("folder", type=Path, help="folder for the pictures")
    parser.add_argument("--matrix", default="none", help="colour matrix: a camera, or a file of 3 x 3 numbers")
    parser.add_argument("--side", type=int, help="longest side, px; unchanged by default")
    options = parser.parse_args()
    sources = develop_sources(open_scenes(options.data), choose_matrix(options.matrix))
    options.folder.mkdir(parents=True)
    for source in sources:
        picture = (ScaledSource(source, options.side) if options.side else source).read().picture
        name = PurePosixPath(source.name).with_suffix(".png").name
        cv2.imwrite(str(options.folder / name), picture[..., ::-1])
    print(f"{options.folder}: {len(sources)} pictures")


if __name__ == "__main__":
    main()
