"""The table of those who have none: commands that take the folder of a table take `demo:` for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from foundation.errors import InputError, StorageError
from foundation.files import sha256_of
from foundation.folders import cache_folder
from foundation.version import software

DEMO: Final = "demo:"  # What stands in place of a table's folder

CAMERA: Final = "Canon_EOS_600D"
# Incandescent lamp to blue sky, a fluorescent lamp and an LED between.
LIGHTS: Final = "2856K,4000K,D55,D65,FL2,LED-B3,7500K,10000K"

BITS: Final = 4  # Bits kept of each channel: 4096 colours, 5 MB

_SETTINGS: Final = f"""\
[room]
profile = "managed"
paper = "matt"
[chart]
bits = {BITS}
"""


def table_folder(given: Path) -> Path:
    """Return the folder of a table: the one given, or that of the table to begin with, made if it is not there."""
    if str(given) != DEMO:
        return given
    cache = cache_folder()
    if cache is None:
        raise InputError(
            f"{DEMO} needs a place to keep its table, and there is no home folder; set XDG_CACHE_HOME, or make one "
            "with sim table"
        )
    key = sha256_of(repr((software(), CAMERA, LIGHTS, BITS)).encode())[:12]
    folder = cache / f"demo-{key}"
    if not (folder / "lut.json").is_file():
        _make(folder)
    print(f"{DEMO} {folder}: a computed table of {CAMERA}, {8**BITS} colours under {LIGHTS}; see sim table --help")
    return folder


def _make(folder: Path) -> None:
    """Have ``sim table`` make it, as a user would: what makes computed tables stands above this package."""
    options = ["--camera", CAMERA, "--lights", LIGHTS]
    with TemporaryDirectory() as place:
        settings = Path(place) / "settings.toml"
        settings.write_text(_SETTINGS, encoding="utf-8")
        words = [sys.executable, "-m", "synthesis.cli", "table", str(folder), *options, "--settings", str(settings)]
        done = subprocess.run(words, stdout=subprocess.DEVNULL, check=False)
    # Another program may have made it meanwhile, of the same bytes.
    if done.returncode and not (folder / "lut.json").is_file():
        raise StorageError(
            f"the table for {DEMO} could not be made in {folder}: sim table ended with exit code {done.returncode}, "
            "and says above why; mend that, or make a table elsewhere with sim table"
        )
