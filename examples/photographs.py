"""Save four photographs of scikit-image as PNG files, for use as source pictures.

Usage: python examples/photographs.py FOLDER. Sources and licences are listed in data/README.txt of scikit-image; the
photographs are not part of CroP.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

try:
    import skimage.data
except ModuleNotFoundError:
    sys.exit("scikit-image is not installed; install it with: pip install scikit-image, or use your own photographs")

NAMES = ("astronaut", "chelsea", "coffee", "rocket")


def main(folder: Path) -> int:
    """Write the photographs to `folder`; return the exit code."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        photograph = np.asarray(getattr(skimage.data, name)(), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), photograph[..., ::-1])
    print(f"{folder}: {len(NAMES)} photographs")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/photographs.py FOLDER")
    sys.exit(main(Path(sys.argv[1])))
