# What we use of PyTorch, which is not installed where types are checked.
from typing import Any

from torch import utils as utils

Tensor = Any
float32: Any

def from_numpy(array: Any) -> Tensor: ...
def __getattr__(name: str) -> Any: ...
