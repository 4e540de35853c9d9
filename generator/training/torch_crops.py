"""Training batches as PyTorch takes them: the only module that imports it, and no other imports this one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from foundation.errors import InputError
from generator.training.crops import Batch, Crops


class TorchMissingError(InputError, ImportError):
    """PyTorch is not installed.

    An InputError, so that a command reports it in one sentence, and an ImportError for callers that can do without.
    """


try:
    import torch
    from torch.utils.data import Dataset
except ImportError as error:
    raise TorchMissingError("training batches for PyTorch need it: pip install torch") from error

# ``image`` (3, height, width) float32, linear camera RGB, 1 = saturation, and ``illuminant`` (3,) float32, r + g + b
# = 1; a batch has N as its first dimension.
Item = dict[str, Any]


def _tensors(batch: Batch) -> Item:
    return {"image": torch.from_numpy(batch.images), "illuminant": torch.from_numpy(batch.illuminants)}


class CropDataset(Dataset[Item]):
    """The items of an epoch by number, for any sampler.

    With ``collate_fn=collated`` the loader's batches are made in one go, without a copy of each item.
    """

    def __init__(self, crops: Crops) -> None:
        self.crops = crops

    def __len__(self) -> int:
        """Return the items of an epoch."""
        return len(self.crops)

    def __getitem__(self, item: int) -> Item:  # pyrefly: ignore[bad-override-param-name]
        """Return one item."""
        if not 0 <= item < len(self):
            raise IndexError(f"item {item} of {len(self)}")
        return {name: tensor[0] for name, tensor in _tensors(self.crops.batch([item])).items()}

    def __getitems__(self, items: Sequence[int]) -> _WholeBatch:
        """Return a batch of items as one sequence, which `collated` returns without a copy."""
        return _WholeBatch(_tensors(self.crops.batch(items)))


class _WholeBatch(Sequence[Item]):
    """A batch as the sequence of its items, which is what a loader expects."""

    def __init__(self, whole: Item) -> None:
        self.whole = whole

    def __len__(self) -> int:
        return len(self.whole["image"])

    def __getitem__(self, at: Any) -> Any:
        if not -len(self) <= at < len(self):
            raise IndexError(at)
        return {name: tensor[at] for name, tensor in self.whole.items()}


def collated(items: Any) -> Item:
    """Return the batch that `CropDataset` made; give it to a loader as ``collate_fn``."""
    if isinstance(items, _WholeBatch):
        return items.whole
    return torch.utils.data.default_collate(items)
