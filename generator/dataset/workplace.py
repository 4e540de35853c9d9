"""The place where a dataset is made: work that was interrupted is continued there, and the dataset appears whole.

On a disk everything happens in the hidden folder `.OUT.partial`: `dataset-ID/`, with the plan's identifier, fills with
files, and `plan/` has the plan, the records of the shards that are done, and of those that are not a line for each
image whose files are written. At the end `dataset-ID/` gets its name by one rename, then the rest is removed. An object
store has no rename: the files are written where they stay, plan and records below `OUT/.plan/`, and `dataset.json`,
written last, makes a dataset of them.

Rules that hold inside:

- A place belongs to one plan. Another plan is refused with a message that says how the two differ. A worker of a plan
  that was removed may still be alive: its records bear the identifier of its plan, so they are never taken for ours.
- A program that makes the whole dataset locks the folder alone; programs that make shares of it share the lock.
- A place without a finished image is of no use later and is removed when the work fails; so is one without a finished
  shard where the command is at fault, which has to be another then.
- The lines of images are not synchronised with the disk and may be cut: each bears its own hash and those of its files,
  and what does not agree with them is made again. An object store cannot add to a file, and has no such lines.
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

from foundation.errors import CropError, FormatError, InputError
from foundation.files import (
    clear_folder,
    held_folder,
    partial_path,
    publish_folder,
    require_free,
    sha256_of,
    storage_error,
    stream_sha256,
)
from foundation.records import from_json
from generator.dataset.records import FinishedImage, ShardRecord, shard_key
from generator.stores import DESCRIPTION, LocalStore, RemoteStore, Store, is_remote, local_path, open_store

PLAN: Final = "plan.json"
RECORDS: Final = "shards"
_NOTES: Final = ".plan"
_DONE: Final = ".json"
_IMAGES: Final = ".images"
PlanIdentity = Mapping[str, Any]


@dataclass(frozen=True)
class Workplace:
    """Where a dataset is being made.

    - `files`: what will be the dataset.
    - `notes`: the plan and the shards' records, which are removed at the end.
    - `out`: the dataset's place.
    - `plan_id`: identifier of the plan; see `_plan_id`.
    """

    files: Store
    notes: Store
    out: str
    plan_id: str

    def done(self) -> set[int]:
        """Return the shards that are done."""
        ending = f".{self.plan_id}{_DONE}"
        found = (PurePosixPath(name).name for name in self.notes.names(RECORDS))
        return {int(name.removesuffix(ending)) for name in found if name.endswith(ending)}

    def has(self, shard: int) -> bool:
        """Return whether a shard is done."""
        return self.notes.has(self._record_name(shard))

    def load(self, shard: int) -> ShardRecord:
        """Return the record of a shard that is done."""
        name = self._record_name(shard)
        remedy = "remove it and run the same command again, which makes it anew"
        return from_json(ShardRecord, self.notes.get(name), f"{self.notes.place}/{name}", remedy)

    def commit(self, record: ShardRecord) -> None:
        """Bring the record of a shard to the disk whose files are there: from here on it is done."""
        name = self._record_name(record.shard)
        self.notes.put(name, record.model_dump_json().encode())
        self.notes.sync([name])
        if isinstance(self.notes, LocalStore):
            # Whoever makes the shard at the same time may have it open, and no later reader asks for it.
            with contextlib.suppress(OSError):
                (self.notes.root / self._images_name(record.shard)).unlink(missing_ok=True)

    def note(self, shard: int, image: FinishedImage) -> None:
        """Note that all files of an image of a shard are written; any thread may do so."""
        if isinstance(self.notes, LocalStore):
            line = image.model_dump_json().encode()
            # It begins anew behind a line that was cut.
            self.notes.append(self._images_name(shard), b"\n%s %s\n" % (sha256_of(line).encode(), line))

    def noted(self, shard: int) -> list[FinishedImage]:
        """Return what was noted of the images of a shard, but for what cannot be read; see `is_whole`."""
        name = self._images_name(shard)
        if not isinstance(self.notes, LocalStore) or not self.notes.has(name):
            return []
        found: list[FinishedImage] = []
        # Whoever makes the shard at the same time may be done, and have removed them.
        with contextlib.suppress(FormatError):
            for noted in self.notes.get(name).splitlines():
                sha256, _, line = noted.partition(b" ")
                if sha256 == sha256_of(line).encode():
                    found.append(from_json(FinishedImage, line, f"{self.notes.place}/{name}", "remove it"))
        return found

    def is_whole(self, image: FinishedImage) -> bool:
        """Return whether all files of an image are there as they were written."""
        try:
            for file in image.files:
                with self.files.open(file.name) as stream:
                    if stream_sha256(stream) != file.sha256:
                        return False
        except (CropError, OSError):
            return False
        return True

    def discard(self) -> None:
        """Remove the records of the shards that are done, since to continue would end the same."""
        self.notes.remove(RECORDS)

    def publish(self) -> None:
        """Make a dataset of the files; all of them, the description last, are there."""
        if isinstance(self.files, LocalStore):
            out = Path(self.out)
            require_free(out, "the dataset")
            self.files.sweep()
            publish_folder(self.files.root, out, "the dataset")
        _remove_notes(self.notes)

    def _record_name(self, shard: int) -> str:
        return f"{RECORDS}/{shard_key(shard)}.{self.plan_id}{_DONE}"

    def _images_name(self, shard: int) -> str:
        return f"{RECORDS}/{shard_key(shard)}.{self.plan_id}{_IMAGES}"


def finished(out: str | Path, identity: PlanIdentity) -> bool:
    """Return whether the dataset of this plan is complete; notes that a killed program left are removed then."""
    notes = _notes(out)
    if not open_store(out).has(DESCRIPTION):
        return False
    planned = notes.has(PLAN)
    if planned and list(_differences(_load(notes), _plain(identity))):
        return False
    _remove_notes(notes)
    return planned


def _remove_notes(notes: Store) -> None:
    """Remove the notes, the plan last: until then a program that is run again finds that the dataset is its own."""
    notes.remove(RECORDS)
    if isinstance(notes, LocalStore):
        shutil.rmtree(notes.root.parent, ignore_errors=True)
    else:
        notes.remove("")


def require_free_place(out: str | Path) -> None:
    """Raise an InputError if `out` is taken, so that a command can say so before it does any work."""
    if is_begun(out):
        return
    if isinstance(out, str) and is_remote(out):
        if RemoteStore(out).has(DESCRIPTION):
            raise InputError(f"{out} already holds a dataset; name another place, or remove what is there")
    else:
        require_free(local_path(out), "the dataset")


def holds_dataset(out: str | Path) -> bool:
    """Return whether a dataset is complete at `out`, and no plan lies there that its making was ended by."""
    return open_store(out).has(DESCRIPTION) and not is_begun(out)


def is_begun(out: str | Path) -> bool:
    """Return whether a plan lies at `out` of a dataset that is being made, or was before its program ended."""
    return _notes(out).has(PLAN)


def differences(stored: Any, wanted: Any) -> list[str]:
    """Return each difference of two plans, or of parts of them, in words."""
    return list(_differences(stored, json.loads(json.dumps(wanted))))


@contextmanager
def workplace(out: str | Path, identity: PlanIdentity, alone: bool = True) -> Generator[Workplace]:
    """Open the place where the dataset `out` is being made, or begin one."""
    if isinstance(out, str) and is_remote(out):
        yield from _remote(out, identity)
        return
    path = local_path(out)
    require_free(path, "the dataset")
    # Whole, since a worker may have been started in another folder.
    folder = partial_path(path).absolute()
    busy = f"{path} is being made by another program; wait for it, or name another place"
    planned = None if alone else (folder / "plan" / PLAN).is_file
    with held_folder(folder, busy, share_if=planned, of=path) as lock:
        notes = LocalStore(folder / "plan")
        plan_id = _plan_id(identity)
        place = Workplace(LocalStore(folder / f"dataset-{plan_id}"), notes, str(path), plan_id)
        try:
            if not notes.has(PLAN):
                _require_still_free(path, folder)
                _begin(folder, plan_id)
                notes.put(PLAN, _text(identity))
                notes.sync([PLAN])
            _require_same(notes, identity, path, f"remove {folder}")
            if not alone:
                lock.share()
            yield place
        except BaseException as error:
            # An InputError asks for another command, which could not go on with images of this one.
            useful = _DONE if isinstance(error, InputError) else (_DONE, _IMAGES)
            if alone and folder.is_dir() and not any(name.endswith(useful) for name in notes.names(RECORDS)):
                shutil.rmtree(folder, ignore_errors=True)
            raise


def stored_identity(out: str | Path) -> PlanIdentity:
    """Return the identity of the plan of a dataset that is being made."""
    notes = _notes(out)
    if not notes.has(PLAN):
        raise InputError(f"no dataset is being made at {out}; begin one with generate")
    return _load(notes)


def _notes(out: str | Path) -> Store:
    if isinstance(out, str) and is_remote(out):
        return RemoteStore(f"{out.rstrip('/')}/{_NOTES}")
    return LocalStore(partial_path(local_path(out)) / "plan")


def _remote(out: str, identity: PlanIdentity) -> Generator[Workplace]:
    files, notes = RemoteStore(out), RemoteStore(f"{out.rstrip('/')}/{_NOTES}")
    place = Workplace(files, notes, out, _plan_id(identity))
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


def _require_still_free(path: Path, folder: Path) -> None:
    """Refuse when another program finished the dataset while its hold was waited for; `folder` is then new."""
    try:
        require_free(path, "the dataset")
    except InputError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _begin(folder: Path, plan_id: str) -> None:
    """Make the folders inside; files that are there without a plan are left from before the plan was written."""
    try:
        clear_folder(folder)
        for inner in ("plan", f"dataset-{plan_id}"):
            (folder / inner).mkdir()
    except OSError as error:
        raise storage_error(folder, error) from error


def _text(identity: PlanIdentity) -> bytes:
    return (json.dumps(identity, indent=1) + "\n").encode()


def _plan_id(identity: PlanIdentity) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of the plan's identity."""
    return hashlib.sha256(json.dumps(_plain(identity), sort_keys=True).encode()).hexdigest()[:16]


def _plain(identity: PlanIdentity) -> Any:
    """Return an identity as it is read back."""
    return json.loads(_text(identity))


def _load(notes: Store) -> dict[str, Any]:
    try:
        loaded = json.loads(notes.get(PLAN))
    except ValueError as error:
        raise FormatError(f"{notes.place}/{PLAN} is damaged; remove it and all beside it, then begin anew") from error
    return dict(loaded)


def _require_same(notes: Store, identity: PlanIdentity, out: str | Path, remedy: str) -> None:
    stored = _load(notes)
    differing = list(_differences(stored, _plain(identity)))
    if differing:
        raise InputError(
            f"{out} was begun with another plan ({'; '.join(differing)}); finish it as it was begun, {remedy}, or name "
            "another place"
        )


def _differences(stored: Any, wanted: Any, name: str = "") -> Generator[str]:
    """Yield each difference of two plans, in words."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        one, other = cast("dict[str, Any]", stored), cast("dict[str, Any]", wanted)
        for key in dict.fromkeys([*one, *other]):
            yield from _differences(one.get(key), other.get(key), f"{name} {key}".strip())
    elif stored != wanted:
        yield f"{name} {_short(stored)}, now {_short(wanted)}"


def _short(value: Any, most: int = 40) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}…"
