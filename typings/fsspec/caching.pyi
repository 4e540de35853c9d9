from collections.abc import Callable
from typing import ClassVar

class BaseCache:
    name: ClassVar[str]
    size: int
    fetcher: Callable[[int, int], bytes]
    def __init__(self, blocksize: int, fetcher: Callable[[int, int], bytes], size: int) -> None: ...

def register_cache(cls: type[BaseCache], clobber: bool = False) -> None: ...
