from fsspec.dircache import DirCache
from fsspec.spec import AbstractFileSystem

class AsyncFileSystem(AbstractFileSystem):
    dircache: DirCache
