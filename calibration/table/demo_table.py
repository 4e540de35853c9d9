"""Make and cache the demonstration LUT. Commands accept `demo:` in place of a LUT folder."""

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

DEMO: Final = "demo:"  # name of the demonstration LUT, in place of a LUT folder

CAMERA: Final = "Canon_EOS_600D"
# From incandescent lamp to blue sky, with a fluorescent lamp and an LED.
LIGHTS: Final = "2856K,4000K,D55,D65,FL2,LED-B3,7500K,10000K"

BITS: Final = 4  # bits per channel: 4096 colours; the LUT has 5 MB

_SETTINGS: Final = f"""\
[room]
profile = "managed"
paper = "matt"
[chart]
bits = {BITS}
"""


def table_folder(folder_or_demo: Path) -> Path:
    """Return the folder of a LUT; for `demo:`, the cached demonstration LUT, which is made at first use."""
    if str(folder_or_demo) != DEMO:
        return folder_or_demo
    cache = cache_folder()
    if cache is None:
        raise InputError(
            f"{DEMO} needs a cache folder, but there is no home folder; set XDG_CACHE_HOME, or make a LUT with "
            "sim table"
        )
    key = sha256_of(repr((software(), CAMERA, LIGHTS, BITS)).encode())[:12]
    demo_folder = cache / f"demo-{key}"
    if not (demo_folder / "lut.json").is_file():
        _make(demo_folder)
    print(f"{DEMO} {demo_folder}: a computed LUT of {CAMERA}, {8**BITS} colours under {LIGHTS}; see sim table --help")
    return demo_folder


def _make(folder: Path) -> None:
    # `sim table` runs as a command, because this package must not import `synthesis`.
    options = ["--camera", CAMERA, "--lights", LIGHTS]
    with TemporaryDirectory() as temporary:
        settings = Path(temporary) / "settings.toml"
        settings.write_text(_SETTINGS, encoding="utf-8")
        command = [sys.executable, "-m", "synthesis.cli", "table", str(folder), *options, "--settings", str(settings)]
        completed = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    # Another process may have made an identical folder at the same time.
    if completed.returncode and not (folder / "lut.json").is_file():
        raise StorageError(
            f"the LUT for {DEMO} could not be made in {folder}: sim table returned {completed.returncode}, expected "
            "0; correct the error above, or make a LUT elsewhere with sim table"
        )
