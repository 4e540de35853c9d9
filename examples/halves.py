"""Divide an archive of thumbnails at random: the lights of one part to generate under, the rest to test on.

`python examples/halves.py nus_canon_600d_64x64.npz [FOLDER] [--names PART] [--parts N]` writes for each half H, 0 and
1, into the folder (the working folder by default): `half_H.npz`, the images, for `evaluate transfer`; and
`lights_H.csv` (r,g,b a line, of sum 1) for `generate --match`. A set that was made by half 0 is tested on the images of
half 1 and the reverse, so that every image is tested once and no test light was looked at. With `--names` only images
whose names contain PART are taken. Of N parts, `others_P.npz` and `others_P.csv` are images and lights of all but part
P, whose images are `half_P.npz`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

# Of the division: that of the figures in docs/transfer.md.
SEED = 0


def main() -> None:
    """Divide the archive, which holds `images` (N, H, W, 3), `gt` (N, 3) and `names` (N,)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path)
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    parser.add_argument("--names", help="take images alone whose names contain this")
    parser.add_argument("--parts", type=int, default=2)
    given = parser.parse_args()
    save: Any = np.savez
    with np.load(given.archive) as content:
        data: dict[str, npt.NDArray[Any]] = {name: content[name] for name in ("images", "gt", "names")}
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.names:
        chosen = np.array([given.names in name for name in data["names"].tolist()])
        data = {name: values[chosen] for name, values in data.items()}
    order = np.random.default_rng(SEED).permutation(len(data["gt"]))
    chromaticities = data["gt"] / data["gt"].sum(axis=1, keepdims=True)
    folds = np.empty(len(order), np.int64)
    for part, places in enumerate(np.array_split(order, given.parts)):
        folds[places] = part
    for part in range(given.parts):
        for name, kept in ((f"half_{part}", folds == part), (f"others_{part}", folds != part)):
            save(given.folder / f"{name}.npz", **{key: values[kept] for key, values in data.items()})
            lights = "".join("{:.6f},{:.6f},{:.6f}\n".format(*row) for row in chromaticities[kept])
            (given.folder / f"{name.replace('half', 'lights')}.csv").write_text(f"r,g,b\n{lights}")
    print(f"{given.folder}: {' and '.join(map(str, np.bincount(folds)))} images")


if __name__ == "__main__":
    main()
