from collections.abc import Callable, Iterator
from typing import Any

class Dataset[T]:
    def __getitem__(self, index: Any) -> T: ...

class IterableDataset[T](Dataset[T]):
    def __iter__(self) -> Iterator[T]: ...

class WorkerInfo:
    id: int
    num_workers: int

class DataLoader[T]:
    def __init__(
        self,
        dataset: Dataset[T],
        batch_size: int | None = ...,
        shuffle: bool = ...,
        *,
        num_workers: int = ...,
        collate_fn: Callable[[Any], Any] | None = ...,
        multiprocessing_context: str | None = ...,
    ) -> None: ...
    def __iter__(self) -> Iterator[T]: ...
    def __len__(self) -> int: ...

def get_worker_info() -> WorkerInfo | None: ...
def default_collate(batch: Any) -> Any: ...
