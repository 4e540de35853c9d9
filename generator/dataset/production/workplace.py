"""The place where a dataset is made, so that it can be gone on with, and appears when it is complete.

On a disk everything happens in the hidden folder `.OUT.partial`: `dataset-MARK/` fills with files, `plan/` holds the
plan and the records of the shards that are done. At the end `dataset-MARK/` gets its name by one rename, then the rest
is removed. An object store has no rename: the files lie where they stay, the notes below `OUT/.plan/`, and
`dataset.json`, written last, makes a dataset of them.

Laws that hold inside:

- A place belongs to one plan. Another plan is refused, and told in what it differs. A worker of a plan that was removed
  from here may still be alive: its records bear the mark of its plan, so they are never taken for ours.
- Whoever makes the whole dataset holds the folder alone; those who make a share each hold it together.
- What holds no finished shard is not worth keeping and is removed when the work fails.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final, cast

from pydantic import ValidationError

from foundation.errors import FormatError, InputError
from foundation.files import partial_path, publish_folder, require_free, storage_error
from foundation.held_folders import LOCK_FILE, held_folder
from generator.dataset.production.records import ShardRecord, shard_key
from generator.dataset.store import DESCRIPTION, LocalStore, RemoteStore, Store, is_remote, local_path, open_store

PLAN: Final = "plan.json"
RECORDS: Final = "shards"
_NOTES: Final = ".plan"
Identity = Mapping[str, Any]


@dataclass(frozen=True)
class Workplace:
    """Where a dataset is being made.

    Attributes
    ----------
    files
        What will be the dataset.
    notes
        The plan and the shards' records, which will be thrown away.
    out
        The dataset's place.
    mark
        Of the plan.
    """

    files: Store
    notes: Store
    out: str
    mark: str

    def done(self) -> set[int]:
        """Return the shards that are done."""
        ending = f".{self.mark}.json"
        found = (PurePosixPath(name).name for name in self.notes.names(RECORDS))
        return {int(name.removesuffix(ending)) for name in found if name.endswith(ending)}

    def has(self, shard: int) -> bool:
        """Return whether a shard is done."""
        return self.notes.has(self._record_name(shard))

    def load(self, shard: int) -> ShardRecord:
        """Return the record of a shard that is done.

        Raises
        ------
        FormatError
            There is none, or it is damaged.
        """
        name = self._record_name(shard)
        try:
            return ShardRecord.model_validate_json(self.notes.get(name))
        except ValidationError as error:
            raise FormatError(
                f"{self.notes.place}/{name} is damaged; remove it and run the same command again, which makes it anew"
            ) from error

    def commit(self, record: ShardRecord) -> None:
        """Bring the record of a shard to the disk whose files are there: from here on it is done."""
        name = self._record_name(record.shard)
        self.notes.put(name, record.model_dump_json().encode())
        self.notes.settle([name])

    def discard(self) -> None:
        """Forget the shards that are done, since going on would lead to the same end."""
        self.notes.remove(RECORDS)

    def publish(self) -> None:
        """Make a dataset of the files; all of them, the description last, are there.

        Raises
        ------
        InputError
            The place was taken meanwhile.
        StorageError
            The disk is full, read-only or gone.
        """
        if isinstance(self.files, LocalStore):
            out = Path(self.out)
            require_free(out, "the dataset")
            self.files.sweep()
            publish_folder(self.files.root, out, "the dataset")
        _remove_notes(self.notes)

    def _record_name(self, shard: int) -> str:
        return f"{RECORDS}/{shard_key(shard)}.{self.mark}.json"


def finished(out: str | Path, identity: Identity) -> bool:
    """Return whether the dataset of this plan is complete and only its notes are left, which are removed then.

    A program that is killed between the two leaves it so.
    """
    notes = _notes(out)
    if not open_store(out).has(DESCRIPTION):
        return False
    known = notes.has(PLAN)
    if known and list(_differences(_load(notes), _plain(identity))):
        return False
    _remove_notes(notes)
    return known


def _remove_notes(notes: Store) -> None:
    """Remove the notes, the plan last: until then a program that is run again knows that the dataset is its own."""
    notes.remove(RECORDS)
    if isinstance(notes, LocalStore):
        shutil.rmtree(notes.root.parent, ignore_errors=True)
    else:
        notes.remove("")


def require_free_place(out: str | Path) -> None:
    """Raise an InputError if `out` is taken, so that a command can say so before it does any work."""
    if _notes(out).has(PLAN):
        return
    if isinstance(out, str) and is_remote(out):
        if RemoteStore(out).has(DESCRIPTION):
            raise InputError(f"{out} already holds a dataset; name another place, or remove what is there")
    else:
        require_free(local_path(out), "the dataset")


@contextmanager
def workplace(out: str | Path, identity: Identity, alone: bool = True) -> Generator[Workplace]:
    """Open the place where the dataset `out` is being made, or begin one.

    Parameters
    ----------
    out
        Path or URL of the dataset.
    identity
        Of the plan; see `plan.Plan.identity`.
    alone
        Whether no other program may be at the same dataset.

    Raises
    ------
    InputError
        The place is taken, belongs to another plan, or another program is at it.
    StorageError
        The disk is full, read-only or gone.
    """
    if isinstance(out, str) and is_remote(out):
        yield from _remote(out, identity)
        return
    path = local_path(out)
    require_free(path, "the dataset")
    # Whole, since a worker may have been started in another folder.
    folder = partial_path(path).absolute()
    busy = f"{path} is being made by another program; wait for it, or name another place"
    planned = None if alone else (folder / "plan" / PLAN).is_file
    with held_folder(folder, busy, share_if=planned) as lock:
        notes = LocalStore(folder / "plan")
        mark = _mark(identity)
        place = Workplace(LocalStore(folder / f"dataset-{mark}"), notes, str(path), mark)
        try:
            if not notes.has(PLAN):
                _begin(folder, mark)
                notes.put(PLAN, _text(identity))
                notes.settle([PLAN])
            _require_same(notes, identity, path, f"remove {folder}")
            if not alone:
                lock.share()
            yield place
        except BaseException:
            if alone and folder.is_dir() and not any(notes.names(RECORDS)):
                shutil.rmtree(folder, ignore_errors=True)
            raise


def stored_identity(out: str | Path) -> Identity:
    """Return the identity of the plan of a dataset that is being made.

    Raises
    ------
    InputError
        No dataset is being made there.
    """
    notes = _notes(out)
    if not notes.has(PLAN):
        raise InputError(f"no dataset is being made at {out}; begin one with generate")
    return _load(notes)


def _notes(out: str | Path) -> Store:
    if isinstance(out, str) and is_remote(out):
        return RemoteStore(f"{out.rstrip('/')}/{_NOTES}")
    return LocalStore(partial_path(local_path(out)) / "plan")


def _remote(out: str, identity: Identity) -> Generator[Workplace]:
    files, notes = RemoteStore(out), RemoteStore(f"{out.rstrip('/')}/{_NOTES}")
    place = Workplace(files, notes, out, _mark(identity))
    if files.has(DESCRIPTION):
        raise InputError(f"{out} already holds a dataset; name another place, or remove what is there")
    begun = notes.has(PLAN)
    if not begun:
        if next(files.names(), None) is not None:
            raise InputError(f"{out} already holds something else; name another place, or remove what is there")
        notes.put(PLAN, _text(identity))
    _require_same(notes, identity, out, f"remove what is below {out}")
    try:
        yield place
    except BaseException:
        with contextlib.suppress(Exception):
            if not begun and not any(notes.names(RECORDS)):
                files.remove("")
        raise


def _begin(folder: Path, mark: str) -> None:
    """Make the folder's rooms; what lies there without a plan is a leftover from before the plan was written."""
    try:
        for path in folder.iterdir():
            if path.name == LOCK_FILE:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        for room in ("plan", f"dataset-{mark}"):
            (folder / room).mkdir()
    except OSError as error:
        raise storage_error(folder, error) from error


def _text(identity: Identity) -> bytes:
    return (json.dumps(identity, indent=1) + "\n").encode()


def _mark(identity: Identity) -> str:
    """Return by what a plan is known in names."""
    return hashlib.sha256(json.dumps(_plain(identity), sort_keys=True).encode()).hexdigest()[:16]


def _plain(identity: Identity) -> Any:
    """Return an identity as it is read back."""
    return json.loads(_text(identity))


def _load(notes: Store) -> dict[str, Any]:
    try:
        loaded = json.loads(notes.get(PLAN))
    except ValueError as error:
        raise FormatError(f"{notes.place}/{PLAN} is damaged; remove it and all beside it, then begin anew") from error
    return dict(loaded)


def _require_same(notes: Store, identity: Identity, out: str | Path, remedy: str) -> None:
    stored = _load(notes)
    differing = list(_differences(stored, _plain(identity)))
    if differing:
        raise InputError(
            f"{out} was begun with another plan ({'; '.join(differing)}); finish it as it was begun, {remedy}, or name "
            "another place"
        )


def _differences(stored: Any, wanted: Any, name: str = "") -> Generator[str]:
    """Yield in what two plans differ, each in words."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        one, other = cast("dict[str, Any]", stored), cast("dict[str, Any]", wanted)
        for key in dict.fromkeys([*one, *other]):
            yield from _differences(one.get(key), other.get(key), f"{name} {key}".strip())
    elif stored != wanted:
        yield f"{name} {_short(stored)}, now {_short(wanted)}"


def _short(value: Any, most: int = 40) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}…"
