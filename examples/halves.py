"""Halve an archive of thumbnails at random: the lights of one half to generate under, the other half to test on.

`python examples/halves.py nus_canon_600d_64x64.npz` writes `lights_of_one_half.csv` (r,g,b a line, of sum 1), for
`generate --match`, and `other_half.npz`, for `evaluate transfer --test`, into the working folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

SEED = 0
"""Of the division: that of the figures in docs/how-to/transfer.md."""


def main(archive: str) -> None:
    """Divide the archive, which holds `images` (N, H, W, 3), `gt` (N, 3) and `names` (N,)."""
    with np.load(archive) as content:
        data = {name: content[name] for name in ("images", "gt", "names")}
    order = np.random.default_rng(SEED).permutation(len(data["gt"]))
    lights, test = (np.sort(part) for part in np.array_split(order, [len(order) // 2]))
    chromaticities = data["gt"][lights] / data["gt"][lights].sum(axis=1, keepdims=True)
    rows = "".join("{:.6f},{:.6f},{:.6f}\n".format(*row) for row in chromaticities)
    Path("lights_of_one_half.csv").write_text(f"r,g,b\n{rows}")
    np.savez("other_half.npz", **{name: values[test] for name, values in data.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
