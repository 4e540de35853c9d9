"""Random changes that a careless or hostile sender makes to a folder, drawn from a seed.

Bytes are flipped, cut, doubled. Numbers, texts and JSON values are replaced by extreme ones. Tar headers are wrong,
SQLite tables become views, files become links, pipes, devices or folders. Half of the time the hashes are corrected, so
that the code behind the hash check is reached.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import sqlite3
import tarfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

from tests.fuzz.foreign.seeds import Seed

# Name of a file outside the folder that must not be touched.
CANARY = "canary.png"

NUMBERS = [
    "-1",
    "0",
    "1",
    "7",
    "255",
    "256",
    "65536",
    "2147483648",
    "9" * 19,
    "9" * 40,
    "9" * 5000,
    "1e309",
    "-1e309",
    "nan",
    "1e-320",
    "0.5",
    "٣",
    "0x10",
    "1_0",
    "",
]

TEXTS = [
    "",
    "..",
    "../outside/canary.png",
    "/dev/zero",
    "/etc/passwd",
    "\0",
    "a/b",
    "a\\b",
    "x" * 70000,
    "\x1b[2J",
    "ä€𝄞",
    "images",
    "images/../../outside/canary.png",
    "nan",
    "null",
    "-",
    "\ufeff",
    "\r",
    '"',
    "000000.png",
    "C:\\x",
]

VALUES: list[Any] = [
    None,
    True,
    -1,
    0,
    1,
    3,
    10**6,
    2**31,
    2**63,
    10**30,
    0.5,
    -0.0,
    1e308,
    "",
    "x",
    [],
    {},
    [[]],
    [None],
    {"a": 1},
    "../outside/canary.png",
    "x" * 3000,
    [0] * 1000,
    float("nan"),
    float("inf"),
    "\ud800",
    "9" * 300,
]

Mutation = Callable[[random.Random, Seed, str], None]


def mutate(rng: random.Random, seed: Seed) -> tuple[Seed, Callable[[Path], None]]:
    """Return the files of a folder after some changes, and a function that changes the written folder."""
    files = dict(seed)
    folder_changes: list[Callable[[Path], None]] = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        # Lists and descriptions matter most, but there are few among the images.
        names = sorted(files)
        if not names:
            break
        text_files = [
            name for name in names if name.endswith((".json", ".csv", ".txt", ".toml", "SUMS", ".sqlite", ".npy"))
        ]
        name = rng.choice(text_files if text_files and rng.random() < 0.7 else names)
        if rng.random() < 0.15:
            folder_changes.append(_replacement(rng, name))
        else:
            rng.choice(_mutations_of(name))(rng, files, name)
    if rng.random() < 0.5:
        with suppress(Exception):
            reseal(files)

    def change(folder: Path) -> None:
        for step in folder_changes:
            with suppress(OSError):
                step(folder)

    return files, change


def reseal(files: Seed) -> None:
    """Correct the hashes of a folder, as an attacker would."""
    if "zarr.json" in files:
        description = json.loads(files["zarr.json"])
        texts = description["attributes"]["files"]
        inner = {name: text.encode() for name, text in texts.items()}
        reseal(inner)
        texts.update({name: text.decode() for name, text in inner.items() if name in texts})
        files["zarr.json"] = json.dumps(description).encode()
    if "lut.json" in files:
        provenance = json.loads(files["lut.json"])
        provenance["illuminations_sha256"] = _hash(files["illuminations.csv"])
        if "samples.npy" in files:
            provenance["samples_sha256"] = _hash(files["samples.npy"])
            size = 8 * 4 * 3 * 2
            data = files["samples.npy"][128:]
            provenance["lights_sha256"] = [
                _hash(data[i * size : (i + 1) * size]) for i in range(len(provenance["lights_sha256"]))
            ]
        provenance["files_sha256"] = {name: _hash(files[name]) for name in provenance["files_sha256"] if name in files}
        files["lut.json"] = json.dumps(provenance).encode()
    if "SHA256SUMS" in files:
        lines = files["SHA256SUMS"].decode().splitlines()
        rows = [line.partition("  ") for line in lines]
        files["SHA256SUMS"] = "".join(
            f"{_hash(files[name]) if name in files else digest}  {name}\n" for digest, _, name in rows
        ).encode()


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _mutations_of(name: str) -> list[Mutation]:
    by_bytes: list[Mutation] = [_flip, _cut, _double, _zero, _overwrite]
    if name.endswith(".json"):
        return [_json_value, _json_value, _json_value, _json_key, _number, _text, _deep, *by_bytes]
    if name.endswith((".csv", ".txt", ".toml", "SUMS")):
        return [_number, _number, _text, _cell, _line, *by_bytes]
    if name.endswith(".sqlite"):
        return [_sql, _sql, _sql, _schema, *by_bytes]
    if name.endswith(".tar"):
        return [_tar_header, _tar_header, *by_bytes]
    if name.endswith(".npy"):
        return [_npy_head, _number_in_head, *by_bytes]
    return by_bytes


def _random_offset(rng: random.Random, data: bytes) -> int:
    # Headers matter more than pixels.
    range_end = len(data) if rng.random() < 0.5 else min(len(data), 200)
    return rng.randrange(range_end) if range_end else 0


def _flip(rng: random.Random, files: Seed, name: str) -> None:
    data = bytearray(files[name])
    for _ in range(rng.choice((1, 1, 4))):
        if data:
            data[_random_offset(rng, bytes(data))] ^= 1 << rng.randrange(8)
    files[name] = bytes(data)


def _cut(rng: random.Random, files: Seed, name: str) -> None:
    data, offset = files[name], _random_offset(rng, files[name])
    files[name] = data[:offset] if rng.random() < 0.5 else data[:offset] + data[offset + rng.choice((1, 4, 16, 500)) :]


def _double(rng: random.Random, files: Seed, name: str) -> None:
    data, offset = files[name], _random_offset(rng, files[name])
    piece = data[offset : offset + rng.choice((1, 8, 100, len(data)))]
    files[name] = data[:offset] + piece * rng.choice((2, 3, 50)) + data[offset:]


def _zero(rng: random.Random, files: Seed, name: str) -> None:
    data, offset = files[name], _random_offset(rng, files[name])
    size = rng.choice((1, 4, 64, len(data)))
    files[name] = (data[:offset] + bytes([rng.choice((0, 255))]) * size + data[offset + size :])[: len(data)]


def _overwrite(rng: random.Random, files: Seed, name: str) -> None:
    data, offset = files[name], _random_offset(rng, files[name])
    value = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, 1 << 40))
    size = rng.choice((2, 4, 8))
    files[name] = (
        data[:offset] + (value % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big"))) + data[offset + size :]
    )


def _number(rng: random.Random, files: Seed, name: str) -> None:
    matches = list(re.finditer(rb"-?[0-9]+(\.[0-9]+)?", files[name][:200000]))
    if matches:
        match = rng.choice(matches)
        files[name] = files[name][: match.start()] + rng.choice(NUMBERS).encode() + files[name][match.end() :]


def _text(rng: random.Random, files: Seed, name: str) -> None:
    matches = list(re.finditer(rb"[A-Za-z_./]{3,}", files[name][:200000]))
    if matches:
        match = rng.choice(matches)
        word = rng.choice(TEXTS).encode("utf-8", "surrogatepass")
        files[name] = files[name][: match.start()] + word + files[name][match.end() :]


def _cell(rng: random.Random, files: Seed, name: str) -> None:
    lines = files[name].split(b"\n")
    number = rng.randrange(len(lines))
    cells = lines[number].split(b",")
    cells[rng.randrange(len(cells))] = rng.choice([*NUMBERS, *TEXTS]).encode("utf-8", "surrogatepass")
    lines[number] = b",".join(cells)
    files[name] = b"\n".join(lines)


def _line(rng: random.Random, files: Seed, name: str) -> None:
    lines = files[name].split(b"\n")
    number = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[number]
        case 1:
            lines.insert(number, lines[number])
        case 2:
            rng.shuffle(lines)
        case _:
            lines.insert(number, b"0" * 64 + b"  " + rng.choice(TEXTS).encode("utf-8", "surrogatepass"))
    files[name] = b"\n".join(lines)


def _spots(value: Any, matches: list[tuple[Any, Any]]) -> None:
    holder = value
    children: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        children = list(cast("dict[Any, Any]", value).items())
    elif isinstance(value, list):
        children = list(enumerate(cast("list[Any]", value)))
    for key, inner in children:
        matches.append((holder, key))
        _spots(inner, matches)


def _json_value(rng: random.Random, files: Seed, name: str) -> None:
    try:
        content = json.loads(files[name])
    except (ValueError, RecursionError):
        _flip(rng, files, name)
        return
    matches: list[tuple[Any, Any]] = []
    _spots(content, matches)
    if matches:
        # Choose keys of objects as often as the thousands of numbers in lists.
        shallow = [spot for spot in matches if isinstance(spot[0], dict)]
        holder, key = rng.choice(shallow if shallow and rng.random() < 0.8 else matches)
        holder[key] = rng.choice(VALUES)
    files[name] = json.dumps(content if rng.random() < 0.97 else rng.choice(VALUES)).encode()


def _json_key(rng: random.Random, files: Seed, name: str) -> None:
    try:
        content = json.loads(files[name])
    except (ValueError, RecursionError):
        _flip(rng, files, name)
        return
    matches: list[tuple[Any, Any]] = []
    _spots(content, matches)
    holders = [cast("dict[Any, Any]", holder) for holder, _ in matches if isinstance(holder, dict)]
    if holders:
        holder = rng.choice(holders)
        key = rng.choice(sorted(holder))
        value = holder.pop(key)
        if rng.random() < 0.5:
            holder[rng.choice(TEXTS)] = value
    files[name] = json.dumps(content).encode()


def _deep(rng: random.Random, files: Seed, name: str) -> None:
    depth = rng.choice((100, 3000, 100000))
    files[name] = b'{"a":' * depth + b"1" + b"}" * depth if rng.random() < 0.5 else b"[" * depth


def _npy_head(rng: random.Random, files: Seed, name: str) -> None:
    heads = (
        "{'descr': '<u2', 'fortran_order': False, 'shape': (3, 8, 4, 3), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (3, 8, 4, 3), }",
        "{'descr': '<u2', 'fortran_order': True, 'shape': (3, 8, 4, 3), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (3, 8, 1000000000000, 3), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (-3, 8, 4, 3), }",
        "{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (3, 8, 4, 3), }",
        "(" * 9000,
        "{'descr': '<u2', 'fortran_order': 1, 'shape': (True, 8, 4, 3), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': 3, }",
        "__import__('os').mkdir('owned')",
    )
    head = rng.choice(heads).encode()
    size = len(head).to_bytes(2, "little") if rng.random() < 0.8 else b"\xff\xff"
    files[name] = b"\x93NUMPY" + bytes([rng.choice((1, 1, 1, 2, 9)), 0]) + size + head + files[name][128:]


def _number_in_head(rng: random.Random, files: Seed, name: str) -> None:
    head, rest = {"x": files[name][:128]}, files[name][128:]
    _number(rng, head, "x")
    files[name] = head["x"] + rest


def _tar_header(rng: random.Random, files: Seed, name: str) -> None:
    data = bytearray(files[name])
    offset = 512 * rng.randrange(max(len(data) // 512, 1))
    try:
        header = tarfile.TarInfo.frombuf(bytes(data[offset : offset + 512]), "utf-8", "surrogateescape")
    except tarfile.TarError:
        _flip(rng, files, name)
        return
    match rng.randrange(5):
        case 0:
            header.size = rng.choice((0, 1, 2**20, 2**33 - 1, 8**11 - 1))
        case 1:
            header.size = rng.choice((2**40, 2**62, 2**87))
        case 2:
            header.type = rng.choice((b"1", b"2", b"3", b"5", b"6", b"7", b"S", b"x", b"L", b"g", b"K"))
            header.linkname = "../outside/canary.png"
        case 3:
            header.name = rng.choice(("../outside/canary.png", "/etc/passwd", "000000.json", "x" * 90))
        case _:
            header.size = -rng.choice((1, 512, 2**30))
    with suppress(ValueError, OverflowError):
        data[offset : offset + 512] = header.tobuf(tarfile.GNU_FORMAT)[:512]
    files[name] = bytes(data)


def _with_database(files: Seed, name: str, statements: list[str]) -> None:
    path = Path(f"/dev/shm/crop-fuzz-{os.getpid()}.sqlite")
    path.write_bytes(files[name])
    with suppress(sqlite3.Error, OverflowError):
        connection = sqlite3.connect(path, isolation_level=None)
        try:
            connection.execute("PRAGMA writable_schema = ON")
            for statement in statements:
                connection.execute(statement)
        finally:
            connection.close()
    files[name] = path.read_bytes()
    path.unlink()


_COLUMNS = {
    "plan": ("step", "kind", "illumination", "red", "green", "blue"),
    "attempts": (
        "id",
        "step",
        "kind",
        "illumination",
        "file",
        "started_at",
        "ended_at",
        "taken_at",
        "exposure_s",
        "size",
        "sha256",
        "verdict",
        "reason",
    ),
    "events": ("at", "what", "detail"),
    "checks": ("attempt", "position", "name", "value", "low", "high", "unit", "reason"),
    "measurements": ("attempt", "red", "green", "blue", "data", "voids", "lasting"),
    "timings": ("attempt", "name", "seconds"),
    "heartbeat": ("at", "pid", "started", "host", "boot", "state", "sentence", "until"),
    "records": ("key", "text"),
}
_SQL_VALUES = [
    "NULL",
    "-1",
    "0",
    "9223372036854775807",
    "1e308",
    "-1e308",
    "''",
    "'x'",
    "x'00ff'",
    "'../outside/canary.png'",
    "'/etc/passwd'",
    "'frames/../../outside/canary.png'",
    "'light'",
    "'dark'",
    "'accepted'",
    "'voided'",
    "'2026-01-01T00:00:00'",
    "'2026-01-01T00:00:00.000000+00:00'",
    "'9999-99-99'",
    "zeroblob(1000000)",
    "'9e999'",
    "CAST(x'ff' AS TEXT)",
    "char(55296)",
    "'frames'",
    "'frames/x/y'",
    "1.5",
    "printf('%.*c', 100000, 'x')",
]


def _sql(rng: random.Random, files: Seed, name: str) -> None:
    table = rng.choice(list(_COLUMNS))
    column = rng.choice(_COLUMNS[table])
    value = rng.choice(_SQL_VALUES)
    where = rng.choice(("", " WHERE rowid = 1", " WHERE rowid = (SELECT MAX(rowid) FROM {0})")).format(table)
    _with_database(
        files, name, [rng.choice((f"UPDATE {table} SET {column} = {value}{where}", f"DELETE FROM {table}{where}"))]
    )


def _schema(rng: random.Random, files: Seed, name: str) -> None:
    table = rng.choice(list(_COLUMNS))
    columns = ", ".join(f"1 AS {column}" for column in _COLUMNS[table])
    endless = (
        f"CREATE VIEW {table} AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n) SELECT {columns} FROM n"
    )
    _with_database(
        files,
        name,
        rng.choice(
            (
                [f"ALTER TABLE {table} RENAME TO old", endless],
                [f"DROP TABLE {table}"],
                [f"PRAGMA user_version = {rng.choice((0, 1, 2, 3, -1, 2**31 - 1))}"],
                [f"CREATE TRIGGER t AFTER UPDATE ON {table} BEGIN DELETE FROM plan; END"],
                [f"ALTER TABLE {table} ADD COLUMN big TEXT GENERATED ALWAYS AS (hex(zeroblob(400000000)))"],
                [f"ALTER TABLE {table} RENAME COLUMN {_COLUMNS[table][0]} TO other"],
                [f"DROP TABLE {table}", f"CREATE TABLE {table} ({', '.join(_COLUMNS[table])})"],
                [f"UPDATE sqlite_master SET sql = 'CREATE TABLE {table}(x)' WHERE name = '{table}'"],
                [f"UPDATE sqlite_master SET rootpage = 2 WHERE name = '{table}'"],
                [f"CREATE VIEW more AS SELECT * FROM {table}"],
                ["PRAGMA journal_mode = WAL"],
                ["VACUUM"],
            )
        ),
    )


def _replacement(rng: random.Random, name: str) -> Callable[[Path], None]:
    """Return a function that replaces a file by something else, or adds something next to it."""
    kind = rng.randrange(11)

    def replace(folder: Path) -> None:
        path = folder / name
        outside = folder.parent / "outside"
        if path.parent.is_symlink():
            return  # Made by an earlier change; its target must not be touched.
        if kind == 10 and "/" in name:
            inner = folder / name.split("/")[0]
            for inner_path in sorted(inner.rglob("*"), reverse=True):
                inner_path.rmdir() if inner_path.is_dir() and not inner_path.is_symlink() else inner_path.unlink()
            inner.rmdir()
            inner.symlink_to(outside)
            return
        path.unlink(missing_ok=True)
        match kind:
            case 0:
                os.mkfifo(path)
            case 1:
                path.symlink_to(outside / CANARY)
            case 2:
                path.symlink_to("/dev/zero")
            case 3:
                path.symlink_to(path.name)
            case 4:
                path.mkdir()
            case 5:
                path.symlink_to("nowhere")
            case 6:
                with path.open("wb") as stream:
                    stream.truncate(rng.choice((0, 1 << 20, 1 << 40)))
            case 7:
                path.symlink_to("/dev/tty")
            case 8:
                path.symlink_to(os.path.relpath(outside / CANARY, path.parent))
            case _:
                os.mkfifo(
                    folder / rng.choice(("more", "report.json", "report.html", "frames.csv", "splits", "README.md"))
                )

    return replace
