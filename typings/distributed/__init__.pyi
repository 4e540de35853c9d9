from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Generic, ParamSpec, Self, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")

class KilledWorker(Exception): ...

class Future(Generic[_T]):
    key: str
    status: str
    def result(self, timeout: float | None = None) -> _T: ...

class LocalCluster:
    scheduler_address: str
    def __init__(
        self,
        n_workers: int | None = None,
        threads_per_worker: int | None = None,
        processes: bool | None = None,
        host: str | None = None,
        dashboard_address: str | None = ":8787",
        memory_limit: str | float | None = "auto",
        silence_logs: int = ...,
    ) -> None: ...
    def scale(self, n: int) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class Client:
    loop: object
    def __init__(
        self, address: str | LocalCluster, timeout: float | None = None, set_as_default: bool = True
    ) -> None: ...
    def submit(
        self, func: Callable[..., _T], *args: Any, key: str | None = None, pure: bool = True, retries: int = 0
    ) -> Future[_T]: ...
    def nthreads(self) -> dict[str, int]: ...
    def run(self, function: Callable[[], _T]) -> dict[str, _T]: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class as_completed(Generic[_T]):  # noqa: N801
    def __init__(self, futures: Sequence[Future[_T]], loop: object = None) -> None: ...
    def add(self, future: Future[_T]) -> None: ...
    def __iter__(self) -> Iterator[Future[_T]]: ...
