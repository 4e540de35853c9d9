"""The simulated EOS's files: those on its card, and those in its memory that wait to be fetched.

Source: a recorded EOS 60D; ISO 15740:2013 for what is standard.
"""

from __future__ import annotations

from drivers.canon.records import Notice, TransferRequest, encode_object_entries
from drivers.ptp.codes import EosEvent, FilesystemType, ObjectFormat, Property, ResponseCode, StorageType
from drivers.ptp.datasets import ObjectInfo, StorageInfo, encode_u32_array
from sim.camera.eos_state import (
    CARD,
    EMPTY_SLOT,
    Arguments,
    OperationRefusal,
    OperationResult,
    SimulatedEosState,
    StoredObject,
)

_ROOT = 0xFFFFFFFF
"""Parent in GetObjectHandles: only what lies in the root (ISO 15740, GetObjectHandles)."""
_ANY_STORE = _ANY_FORMAT = 0xFFFFFFFF
"""Store or format in GetObjectHandles: all of them."""


class EosFiles(SimulatedEosState):
    """What an initiator can ask of a body's files, and do with them."""

    def _get_storage_ids(self, _: Arguments) -> OperationResult:
        return OperationResult(encode_u32_array((EMPTY_SLOT if self._card is None else CARD,)))

    def _get_storage_info(self, arguments: Arguments) -> OperationResult:
        self._require_store(arguments.one)
        capacity, free = (0, 0) if self._card is None else (self._card.capacity, self._card.free)
        info = StorageInfo(
            StorageType.REMOVABLE_RAM, FilesystemType.DCF, capacity=capacity, free=free, description="SD"
        )
        return OperationResult(info.encode())

    def _require_store(self, storage: int) -> None:
        if storage not in (EMPTY_SLOT if self._card is None else CARD, _ANY_STORE):
            raise OperationRefusal(ResponseCode.INVALID_STORAGE_ID)

    def _on_card(self) -> dict[int, StoredObject]:
        return {} if self._card is None else self._card.objects

    def _children(self, parent: int) -> list[StoredObject]:
        if parent not in (0, _ROOT) and parent not in self._on_card():
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return [item for item in self._on_card().values() if item.parent == (0 if parent == _ROOT else parent)]

    def _listed(self, arguments: Arguments) -> list[StoredObject]:
        self._require_store(arguments.one)
        everything = arguments.three == 0
        found = list(self._on_card().values()) if everything else self._children(arguments.three)
        return [item for item in found if arguments.two in (0, _ANY_FORMAT, item.format)]

    def _get_num_objects(self, arguments: Arguments) -> OperationResult:
        return OperationResult(parameters=(len(self._listed(arguments)),))

    def _get_object_handles(self, arguments: Arguments) -> OperationResult:
        return OperationResult(encode_u32_array(item.handle for item in self._listed(arguments)))

    def _get_object_info_ex(self, arguments: Arguments) -> OperationResult:
        self._require_store(arguments.one)
        return OperationResult(encode_object_entries(item.entry for item in self._children(arguments.two)))

    def _object(self, handle: int) -> StoredObject:
        found = self._memory.get(handle) or self._on_card().get(handle)
        if found is None:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return found

    def _get_object_info(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.one)
        stamp = item.taken_at.strftime("%Y%m%dT%H%M%S")
        folder = item.format == ObjectFormat.ASSOCIATION
        return OperationResult(
            ObjectInfo(
                storage=item.storage, format=item.format, size=len(item.data), parent=item.parent,
                association_type=int(folder), filename=item.name, captured_at=stamp, modified_at=stamp,
            ).encode()
        )  # fmt: skip

    def _get_object(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.one)
        if item.format == ObjectFormat.ASSOCIATION:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return OperationResult(item.data)

    def _get_partial_object(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.one)
        if arguments.two > len(item.data):
            raise OperationRefusal(ResponseCode.INVALID_PARAMETER)
        part = item.data[arguments.two : arguments.two + arguments.three]
        return OperationResult(part, (len(part),))

    def _get_thumb(self, arguments: Arguments) -> OperationResult:
        self._object(arguments.one)
        raise OperationRefusal(ResponseCode.NO_THUMBNAIL_PRESENT)

    def _delete_object(self, arguments: Arguments) -> OperationResult:
        item = self._object(arguments.one)
        if item.format == ObjectFormat.ASSOCIATION:
            raise OperationRefusal(ResponseCode.OBJECT_WRITE_PROTECTED)
        if item.storage:
            del self._on_card()[item.handle]
            self._record(Notice(EosEvent.OBJECT_REMOVED, item.handle))
            self._report(Property.EOS_AVAILABLE_SHOTS)
        else:
            del self._memory[item.handle]
        return OperationResult()

    def _transfer_complete(self, arguments: Arguments) -> OperationResult:
        if self._memory.pop(arguments.one, None) is None:
            raise OperationRefusal(ResponseCode.INVALID_OBJECT_HANDLE)
        return OperationResult()

    def _reset_transfer(self, _: Arguments) -> OperationResult:
        self._memory.clear()
        return OperationResult()

    def _pc_hdd_capacity(self, arguments: Arguments) -> OperationResult:
        self._host_bytes = arguments.one * arguments.two
        self._report(Property.EOS_AVAILABLE_SHOTS)
        return OperationResult()

    def _frames_waiting(self) -> int:
        return len({item.name.rpartition(".")[0] for item in self._memory.values()})

    def _offer_transfer(self, item: StoredObject) -> None:
        wide = self.body.wide_objects
        request = EosEvent.REQUEST_OBJECT_TRANSFER_64 if wide else EosEvent.REQUEST_OBJECT_TRANSFER
        self._record(TransferRequest(item.handle, item.format, len(item.data), item.name, request))
