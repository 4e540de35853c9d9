"""Split an archive of thumbnails at random, to generate with illuminants of one part and test on images of the other.

`python examples/halves.py nus_canon_600d_64x64.npz [FOLDER] [--names PART] [--parts N]` writes two files for each half
H (0, 1). `half_H.npz` contains the images for `evaluate transfer`. `lights_H.csv` contains their illuminants for
`generate --match`: r,g,b in each line, with the sum 1. Test a method on half 1 if its training images were generated
with `lights_0.csv`, and on half 0 with `lights_1.csv`. Each image is then tested once, and its illuminant was not used
in training.

`--names` selects images with PART in their names. With N parts, `half_P.npz` is part P, and `others_P.npz` and
`others_P.csv` contain the images and illuminants of all other parts.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

# Seed of the split, also used for the results in docs/transfer.md.
SEED = 0


def main() -> None:
    """Split the archive, which holds `images` (N, H, W, 3), `gt` (N, 3) and `names` (N,)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path)
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    parser.add_argument("--names", help="use only images with this text in their names")
    parser.add_argument("--parts", type=int, default=2)
    options = parser.parse_args()
    save: Any = np.savez
    with np.load(options.archive) as content:
        data: dict[str, npt.NDArray[Any]] = {name: content[name] for name in ("images", "gt", "names")}
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.names:
        has_name = np.array([options.names in name for name in data["names"].tolist()])
        data = {name: values[has_name] for name, values in data.items()}
    order = np.random.default_rng(SEED).permutation(len(data["gt"]))
    chromaticities = data["gt"] / data["gt"].sum(axis=1, keepdims=True)
    folds = np.empty(len(order), np.int64)
    for part, indices in enumerate(np.array_split(order, options.parts)):
        folds[indices] = part
    for part in range(options.parts):
        for name, is_selected in ((f"half_{part}", folds == part), (f"others_{part}", folds != part)):
            save(options.folder / f"{name}.npz", **{key: values[is_selected] for key, values in data.items()})
            lights = "".join("{:.6f},{:.6f},{:.6f}\n".format(*row) for row in chromaticities[is_selected])
            (options.folder / f"{name.replace('half', 'lights')}.csv").write_text(f"r,g,b\n{lights}")
    print(f"{options.folder}: {' and '.join(map(str, np.bincount(folds)))} images")


if __name__ == "__main__":
    main()
