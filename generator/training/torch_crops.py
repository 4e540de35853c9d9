"""Training batches for PyTorch. Only this module imports PyTorch, and no other module imports this one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from foundation.errors import InputError
from generator.training.crops import Batch, Crops


class TorchMissingError(InputError, ImportError):
    """PyTorch is not installed.

    It is an InputError, so that a command reports it in one sentence, and an ImportError for optional imports.
    """


try:
    import torch
    from torch.utils.data import Dataset
except ImportError as error:
    raise TorchMissingError("PyTorch is not installed, training batches need it; run pip install torch") from error

# ``image`` (3, height, width) float32, linear camera RGB, 1 = saturation, and ``illuminant`` (3,) float32, r + g + b
# = 1; a batch has N as its first dimension.
Item = dict[str, Any]


def _tensors(batch: Batch) -> Item:
    return {"image": torch.from_numpy(batch.images), "illuminant": torch.from_numpy(batch.illuminants)}


class CropDataset(Dataset[Item]):
    """The crops of an epoch as a PyTorch data set, for any sampler.

    With ``collate_fn=collated``, each batch of the loader is made as a whole, without a copy of each crop.
    """

    def __init__(self, crops: Crops) -> None:
        self.crops = crops

    def __len__(self) -> int:
        """Return the number of crops per epoch."""
        return len(self.crops)

    def __getitem__(self, item: int) -> Item:  # pyrefly: ignore[bad-override-param-name]
        """Return one crop."""
        if not 0 <= item < len(self):
            raise IndexError(f"item {item} of {len(self)}")
        return {name: tensor[0] for name, tensor in _tensors(self.crops.batch([item])).items()}

    def __getitems__(self, items: Sequence[int]) -> _WholeBatch:
        """Return a batch of crops as one sequence, which `collated` returns without a copy."""
        return _WholeBatch(_tensors(self.crops.batch(items)))


class _WholeBatch(Sequence[Item]):
    """A batch as a sequence of its crops, as a loader expects."""

    def __init__(self, tensors: Item) -> None:
        self.tensors = tensors

    def __len__(self) -> int:
        return len(self.tensors["image"])

    def __getitem__(self, index: Any) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return {name: tensor[index] for name, tensor in self.tensors.items()}


def collated(items: Any) -> Item:
    """Return the batch that `CropDataset` made; pass this function to a loader as ``collate_fn``."""
    if isinstance(items, _WholeBatch):
        return items.tensors
    return torch.utils.data.default_collate(items)
