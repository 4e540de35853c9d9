"""Develop the raw images of a real data set to sRGB pictures, to generate from: white balanced by their ground truths.

Usage: python examples/develop.py DATA FOLDER [--matrix CAMERA] [--side PX]. DATA is any data set that evaluate reads.
How it is done says evaluation/experiments/paper/material.py; the pictures are PNG, named after the images.
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
    parser.add_argument("folder", type=Path, help="where the pictures go")
    parser.add_argument("--matrix", default="none", help="colour matrix: a camera, or a file of 3 x 3 numbers")
    parser.add_argument("--side", type=int, help="longest side, px; as it is by default")
    chosen = parser.parse_args()
    sources = develop_sources(open_scenes(chosen.data), choose_matrix(chosen.matrix))
    chosen.folder.mkdir(parents=True)
    for source in sources:
        picture = (ScaledSource(source, chosen.side) if chosen.side else source).read().picture
        name = PurePosixPath(source.name).with_suffix(".png").name
        cv2.imwrite(str(chosen.folder / name), picture[..., ::-1])
    print(f"{chosen.folder}: {len(sources)} pictures")


if __name__ == "__main__":
    main()
