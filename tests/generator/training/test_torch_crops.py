"""PyTorch's loader returns the same items with any workers."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from generator import open_lut
from generator.training.crops import Crops
from generator.training.gallery import gallery_of
from tests.generator.conftest import MakeLut

pytestmark = pytest.mark.slow

torch: Any = pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
batches: Any = pytest.importorskip("generator.training.torch_crops")
CropDataset, collated = batches.CropDataset, batches.collated


def crops_of(table: Path | str) -> Crops:
    """Return the crops of a picture under the illuminants of a LUT."""
    rows, columns = np.mgrid[:20, :30]
    picture = (np.stack([columns, rows, rows + columns], axis=-1) % 4 * 64).astype(np.uint8)
    return Crops(open_lut(table), gallery_of([picture]), (6, 5), length=22, exposure=(0.5, 1.5), seed=5)


@pytest.fixture
def crops(make_lut: MakeLut) -> Crops:
    return crops_of(make_lut(bits=2).folder)


def test_loader_returns_every_item_once(crops: Crops) -> None:
    dataset = pickle.loads(pickle.dumps(CropDataset(crops)))
    loaded = list(torch.utils.data.DataLoader(dataset, batch_size=4, collate_fn=collated))
    expected = crops.batch(np.arange(22))
    np.testing.assert_array_equal(torch.cat([batch["image"] for batch in loaded]).numpy(), expected.images)
    np.testing.assert_array_equal(torch.cat([batch["illuminant"] for batch in loaded]).numpy(), expected.illuminants)


def test_default_collate_is_equal(crops: Crops) -> None:
    default_batch = next(iter(torch.utils.data.DataLoader(CropDataset(crops), batch_size=4)))
    whole_batch = next(iter(torch.utils.data.DataLoader(CropDataset(crops), batch_size=4, collate_fn=collated)))
    for name in ("image", "illuminant"):
        assert default_batch[name].dtype == torch.float32
        assert torch.equal(default_batch[name], whole_batch[name])


def test_single_items_and_bounds(crops: Crops) -> None:
    dataset = CropDataset(crops)
    np.testing.assert_array_equal(dataset[21]["image"].numpy(), crops.batch([21]).images[0])
    with pytest.raises(IndexError):
        dataset[22]
