"""Whatever a file of a data set holds, the fault is one of ours, named in a sentence: no other error gets out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evaluation.datasets import DataOptions, open_scenes
from evaluation.scene import MixedScene
from foundation.errors import InputError
from tests.evaluation.datasets.made_up import COPIES

pytestmark = pytest.mark.slow

FILES = {
    "nus8": ("SonyA57/SonyA57_gt.mat", "SonyA57/SonyA57_0001.PNG"),
    "gehler-shi": ("ColorCheckerData.mat", "coordinates/8D5U5524_macbeth.txt", "Canon1D/png/8D5U5524.png"),
    "intel-tau": ("Canon_5DSR/lab_printouts/C_5DSR_lab_010.wp", "Canon_5DSR/lab_printouts/C_5DSR_lab_10.tiff"),
    "lsmi": (
        *("sony/meta.json", "sony/split.json", "sony/Place1/Place1_12.npy"),
        *("sony/Place2/Place2_123.tiff", "sony/Place1/Place1_1.tiff"),
    ),
    "lsmi prepared": ("train/Place1_mask.png", "train/Place1_12.npy", "meta.json"),
    "ffcc": ("folder_1/000001.txt", "folder_2/000001.png"),
    "thumbnails": ("",),
    "folder": ("gt.csv", "a_mask.png", "more/b.tiff", "c.npy"),
}
"""Files of the copies that are quick to read, those of every kind."""


def use(place: Path, partial: bool) -> None:
    """Do with a data set what the commands do."""
    for scene in open_scenes(place, options=DataOptions(partial=partial)).scenes:
        scene.read()
        assert scene.truth.shape == (3,)
        assert scene.saturation is None or np.isfinite(scene.saturation)
        if isinstance(scene, MixedScene):
            scene.read_truth_map()


@st.composite
def damages(draw: st.DrawFn) -> tuple[float, bytes, bool]:
    """Draw where a file is damaged, as a share of its length, what stands there then, and whether it ends there."""
    texts = st.sampled_from(
        [b"", b"\n", b",", b"nan", b"-1", b"1e999", b'"', b"0 0 0", b"\x00", b"\xff\xfe", b"{}", b"[]"]
    )
    return draw(st.floats(0, 1)), draw(st.one_of(texts, st.binary(max_size=4))), draw(st.booleans())


@pytest.mark.parametrize(("name", "file"), [(name, file) for name, files in FILES.items() for file in files])
@pytest.mark.filterwarnings("ignore")  # Of libraries that read damaged files; what counts is how it ends.
def test_a_damaged_file_is_our_error(name: str, file: str, tmp_path: Path) -> None:
    copy = COPIES[name]
    copy.make(tmp_path)
    place = tmp_path / copy.at
    path = place / file
    whole = path.read_bytes()
    use(place, copy.partial)

    @settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(damages())
    def damage(how: tuple[float, bytes, bool]) -> None:
        where, instead, cut = how
        at = int(where * len(whole))
        path.write_bytes(whole[:at] + instead + (b"" if cut else whole[at + len(instead) :]))
        faults: list[str] = []
        try:
            use(place, copy.partial)
        except InputError as error:
            faults.append(str(error))
        assert all(str(place) in fault for fault in faults)

    damage()
