"""Numbers published in the CroP paper, for comparison with our results.

N. Banić, K. Koščević, M. Subašić, S. Lončarić, "CroP: Color constancy benchmark dataset generator", tables 1 and 2. The
numbers in its figures are not published.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import PurePosixPath
from typing import Final, Literal


@dataclass(frozen=True)
class PublishedRow:
    """Statistics of a method as published, degrees; see `evaluation.metrics.Summary`."""

    mean: float
    median: float
    trimean: float
    best25: float
    worst25: float
    avg: float

    def as_tuple(self) -> tuple[float, ...]:
        """Return the six statistics."""
        return astuple(self)


BlockKey = tuple[str, str, str]  # Scenes, sensor and illuminants of a data set of table 1

# Table 1, by data set and method in the order of the paper. C1 is the Canon 1Ds Mark III of the NUS data set.
# Section 4.1 calls the errors reproduction errors. This cannot be true for all numbers: the largest possible
# reproduction error is arccos(1/√3) = 54.74°, but one worst 25 % is 59.80°. The commands therefore report both kinds of
# error.
TABLE1: Final[Mapping[BlockKey, Mapping[str, PublishedRow]]] = {
    ("C1", "6D", "C1"): {
        "White-Patch": PublishedRow(2.61, 2.59, 2.50, 1.03, 4.38, 2.38),
        "Gray-world": PublishedRow(6.27, 5.32, 5.58, 3.34, 10.75, 5.82),
        "Shades-of-Gray (p=2)": PublishedRow(2.79, 2.36, 2.40, 1.28, 5.12, 2.53),
    },
    ("C1", "6D", "Random"): {
        "White-Patch": PublishedRow(2.17, 2.05, 2.08, 0.88, 3.73, 1.98),
        "Gray-world": PublishedRow(5.79, 5.20, 5.38, 2.64, 9.82, 5.30),
        "Shades-of-Gray (p=2)": PublishedRow(2.34, 1.93, 1.96, 0.98, 4.43, 2.08),
    },
    ("C1", "550D", "C1"): {
        "White-Patch": PublishedRow(9.41, 5.38, 5.56, 2.60, 23.56, 7.04),
        "Gray-world": PublishedRow(5.75, 5.25, 5.39, 2.75, 9.45, 5.31),
        "Shades-of-Gray (p=2)": PublishedRow(2.61, 2.07, 2.14, 0.97, 5.20, 2.25),
    },
    ("C1", "550D", "Random"): {
        "White-Patch": PublishedRow(10.90, 6.75, 6.81, 2.90, 27.18, 8.31),
        "Gray-world": PublishedRow(5.25, 5.04, 5.07, 2.65, 8.32, 4.94),
        "Shades-of-Gray (p=2)": PublishedRow(2.15, 1.73, 1.83, 0.67, 4.35, 1.82),
    },
    ("Random", "6D", "C1"): {
        "White-Patch": PublishedRow(2.59, 2.23, 2.37, 1.31, 4.31, 2.38),
        "Gray-world": PublishedRow(3.84, 4.06, 3.96, 3.06, 4.34, 3.82),
        "Shades-of-Gray (p=2)": PublishedRow(2.73, 2.78, 2.78, 1.95, 3.22, 2.66),
    },
    ("Random", "6D", "Random"): {
        "White-Patch": PublishedRow(2.46, 2.15, 2.33, 0.88, 4.34, 2.16),
        "Gray-world": PublishedRow(4.09, 4.16, 4.20, 2.53, 5.38, 3.96),
        "Shades-of-Gray (p=2)": PublishedRow(2.47, 2.64, 2.57, 1.54, 3.17, 2.42),
    },
    ("Random", "550D", "C1"): {
        "White-Patch": PublishedRow(22.79, 10.35, 19.52, 6.43, 51.43, 17.24),
        "Gray-world": PublishedRow(3.99, 4.28, 4.14, 2.16, 5.65, 3.86),
        "Shades-of-Gray (p=2)": PublishedRow(2.36, 2.43, 2.31, 1.13, 3.68, 2.23),
    },
    ("Random", "550D", "Random"): {
        "White-Patch": PublishedRow(25.81, 12.30, 21.33, 7.45, 59.80, 19.77),
        "Gray-world": PublishedRow(4.25, 4.23, 4.20, 2.44, 6.15, 4.08),
        "Shades-of-Gray (p=2)": PublishedRow(4.01, 2.80, 2.81, 0.85, 9.69, 3.04),
    },
}

# Names of the images of C1 in every copy of the data set, without folder and extension.
_C1_NAME: Final = re.compile(r"Canon1DsMkIII_\d{4}")
_C1_IMAGES: Final = 259  # Number of images of C1; only statistics of all of them are comparable


def is_c1(images: Sequence[str]) -> bool:
    """Return True if the list has the names of all images of C1, in any order.

    Examples
    --------
    >>> whole = [f"Canon1DsMkIII/Canon1DsMkIII_{number:04d}.PNG" for number in range(1, 260)]
    >>> is_c1(whole), is_c1(whole[:20]), is_c1(["Canon600D_0001"] * 259)
    (True, False, False)
    """
    stems = {PurePosixPath(name).stem for name in images}
    return len(images) == len(stems) == _C1_IMAGES and all(_C1_NAME.fullmatch(stem) for stem in stems)


def name_in_table1(name: str, images: Sequence[str]) -> str:
    """Return the name of a set of pictures or of ground truths for table 1.

    Images of C1 get the name C1. Other images with the name C1 or Random get this name in quotes.

    Examples
    --------
    >>> name_in_table1("600D", ["Canon600D_0001"]), name_in_table1("C1", ["a"]), name_in_table1("Random", ["a"])
    ('600D', '"C1"', '"Random"')
    """
    if is_c1(images):
        return "C1"
    return f'"{name}"' if name in ("C1", "Random") else name


# Table 2: results on Cube+ by training data. "real" is cross-validation on Cube+.
TABLE2: Final[Mapping[Literal["real", "generated"], Mapping[str, PublishedRow]]] = {
    "real": {
        "Smart Color Cat": PublishedRow(2.27, 1.35, 1.61, 0.34, 5.72, 1.58),
        "Regression trees (simple features)": PublishedRow(1.57, 0.89, 1.04, 0.20, 4.15, 1.04),
        "Color Beaver (using Gray-world)": PublishedRow(1.49, 0.77, 0.98, 0.21, 3.94, 0.99),
    },
    "generated": {
        "Regression trees (simple features)": PublishedRow(2.54, 1.66, 1.89, 0.45, 6.07, 1.85),
        "Smart Color Cat": PublishedRow(2.47, 1.43, 1.76, 0.40, 6.21, 1.73),
        "Color Beaver (using Gray-world)": PublishedRow(1.73, 0.74, 0.97, 0.37, 4.75, 1.17),
    },
}
