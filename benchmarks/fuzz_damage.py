"""Damage files in a seeded way that keeps their structure, for benchmarks/fuzz.py."""

from __future__ import annotations

import copy
import io
import json
import random
import re
import struct
import warnings
import zipfile
from typing import Any

import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq

NUMBERS = [0, -1, 1, 2, 7, 255, 2**31 - 1, -(2**31), 2**32, 2**53, 2**63 - 1, 2**64, 1e9, 1e38, 1e300, -1e-300, 0.5]
NUMBERS += [float("nan"), float("inf"), float("-inf")]
VALUES: list[Any] = [
    *NUMBERS,
    None,
    True,
    False,
    "",
    "0",
    "NaN",
    "x" * 300,
    "../../x",
    "\x00",
    "é",
    [],
    {},
    [[]],
    [1, 2],
    [None],
]


def change_bytes(content: bytes, rng: random.Random) -> bytes:
    """Change, delete, insert or repeat some bytes; the beginning and the end are changed more often."""
    data = bytearray(content)

    def place() -> int:
        size = len(data)
        near = min(size, 200)
        return rng.choice([rng.randrange(size), rng.randrange(near), size - 1 - rng.randrange(near)]) if size else 0

    kind = rng.choice(["flip", "flip", "set", "cut", "insert", "delete", "repeat", "zero"])
    for _ in range(rng.choice([1, 1, 2, 8])):
        if not data:
            break
        at = place()
        if kind == "flip":
            data[at] ^= 1 << rng.randrange(8)
        elif kind == "set":
            data[at] = rng.choice([0, 1, 127, 128, 255, rng.randrange(256)])
        elif kind == "insert":
            data[at:at] = rng.randbytes(rng.choice([1, 4, 16]))
        elif kind == "delete":
            del data[at : at + rng.choice([1, 4, 16])]
        elif kind == "repeat":
            data[at:at] = data[at : at + rng.choice([1, 8, 64])]
        elif kind == "zero":
            data[at : at + 8] = bytes(len(data[at : at + 8]))
    return bytes(data[: place()] if kind == "cut" else data)


def change_tree(tree: Any, rng: random.Random, times: int = 1) -> Any:
    """Change entries of a JSON value: replace, delete, repeat or exchange them."""
    tree = copy.deepcopy(tree)
    for _ in range(times):
        places = list(list_places(tree))
        if not places:
            return rng.choice(VALUES)
        parent, key = rng.choice(places)
        kind = rng.choice(["replace", "replace", "replace", "near", "delete", "repeat", "exchange"])
        if kind == "replace":
            parent[key] = copy.deepcopy(rng.choice(VALUES))
        elif kind == "near" and isinstance(parent[key], (int, float)) and not isinstance(parent[key], bool):
            parent[key] = rng.choice(
                [parent[key] + 1, parent[key] - 1, -parent[key], parent[key] * 1000, parent[key] / 3]
            )
        elif kind == "delete":
            del parent[key]
        elif kind == "repeat" and isinstance(parent, list):
            parent[key:key] = [copy.deepcopy(parent[key])] * rng.choice([1, 3, 1000])
        else:
            other, name = rng.choice(places)
            parent[key] = copy.deepcopy(other[name])
    return tree


def list_places(tree: Any):
    """Yield (container, key) of each entry of a JSON value."""
    todo = [tree]
    while todo:
        one = todo.pop()
        for key in list(one) if isinstance(one, dict) else range(len(one)) if isinstance(one, list) else ():
            yield one, key
            todo.append(one[key])


def dump_json(tree: Any, rng: random.Random) -> bytes:
    """Write JSON, sometimes with a repeated key or very deep nesting."""
    text = json.dumps(tree)
    if rng.random() < 0.03 and text.startswith("{"):
        text = '{"' + rng.choice(list(tree) or ["x"]).replace('"', "") + '": 1, ' + text[1:]
    if rng.random() < 0.02:
        text = text.replace(":", ":" + "[" * 20_000 + "]" * 20_000 + ",", 1)
    return text.encode("utf-8", "surrogatepass")


def change_table(table: pa.Table, rng: random.Random) -> pa.Table:
    """Change values, rows or columns of a table."""
    if len(set(table.column_names)) < len(table.column_names):
        return table
    kind = rng.choice(["value"] * 6 + ["rows", "order", "drop", "rename", "type", "twice"])
    name = rng.choice(table.column_names)
    index = table.column_names.index(name)
    if kind == "value" and len(table):
        values = table[name].to_pylist()
        for _ in range(rng.choice([1, 1, 3])):
            row = rng.randrange(len(values))
            values[row] = change_value(values[row], values, rng)
        try:
            return table.set_column(index, table.schema.field(index), pa.array(values, table.schema.field(index).type))
        except (pa.ArrowException, OverflowError, TypeError, ValueError):
            return change_table(table, rng)  # The type of the column cannot hold the value.
    if kind == "rows":
        return table.slice(rng.randrange(len(table) + 1), rng.randrange(len(table) + 1))
    if kind == "order":
        order = list(range(len(table)))
        a, b = (rng.randrange(len(order)) for _ in range(2)) if order else (0, 0)
        if order:
            order[a] = order[b] if rng.random() < 0.5 else order[a]
            order[a], order[b] = order[b], order[a]
        return table.take(pa.array(order, pa.int64()))
    if kind == "drop":
        return table.remove_column(index)
    if kind == "rename":
        return table.rename_columns(
            [other if k != index else rng.choice(["x", name + "_"]) for k, other in enumerate(table.column_names)]
        )
    if kind == "twice":
        return table.append_column(table.schema.field(index), table[name])
    kind_of = rng.choice([pa.string(), pa.float32(), pa.float64(), pa.int64(), pa.int8()])
    try:
        return table.set_column(index, name, table[name].cast(kind_of))
    except pa.ArrowException:
        return table.set_column(index, name, pa.nulls(len(table), kind_of))


def change_value(value: Any, others: list, rng: random.Random) -> Any:
    if isinstance(value, bytes):
        return rng.choice([b"", value[:-1], value + b"\0", change_bytes(value, rng), rng.choice(others), None])
    if isinstance(value, list) and value and rng.random() < 0.8:
        return change_tree(value, rng)
    return rng.choice([rng.choice(VALUES), rng.choice(NUMBERS), rng.choice(others), None])


def write_parquet(table: pa.Table, rng: random.Random) -> bytes:
    """Write a table with options that other programs use."""
    file = io.BytesIO()
    options: Any = {
        "compression": rng.choice(["zstd", "snappy", "none", "gzip"]),
        "use_dictionary": rng.random() < 0.7,
        "row_group_size": rng.choice([None, 1, 7]),
        "data_page_version": rng.choice(["1.0", "2.0"]),
        "write_page_checksum": rng.random() < 0.5,
        "store_schema": rng.random() < 0.8,
    }
    pq.write_table(table, file, **options)
    return file.getvalue()


def split_glb(content: bytes) -> tuple[Any, bytes]:
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def join_glb(text: bytes, binary: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if binary:
        chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def change_glb(content: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.25:
        return change_bytes(content, rng)
    tree, binary = split_glb(content)
    if rng.random() < 0.15:
        binary = change_bytes(binary, rng)
    else:
        tree = change_tree(tree, rng, rng.choice([1, 1, 2]))
    return join_glb(dump_json(tree, rng), binary)


def change_npz(content: bytes, rng: random.Random) -> bytes:
    """Change bytes, or write the zip archive again with other entries, headers, sizes or methods."""
    if rng.random() < 0.4:
        return change_bytes(content, rng)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [(info.filename, archive.read(info)) for info in archive.infolist()]
    k = rng.randrange(len(entries))
    name, data = entries[k]
    kind = rng.choice(["header", "header", "data", "name", "twice", "empty", "extra"])
    kind = "bomb" if rng.random() < 0.01 else kind
    if kind == "header":
        data = change_npy_header(data, rng)
    elif kind == "data":
        data = change_bytes(data, rng)
    elif kind == "name":
        name = rng.choice(["../x.npy", "x", "/", "voxels.npy", "arr_0.npy", "a" * 1000])
    elif kind == "bomb":
        data = (
            b"\x93NUMPY\x01\x00v\x00"
            + f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**26},)}}".ljust(117).encode()
            + b"\n"
        )
        data += bytes(2**27)
    entries[k] = name, b"" if kind == "empty" else data
    if kind in ("twice", "extra"):
        entries.append((name if kind == "twice" else "extra.npy", data))
    file = io.BytesIO()
    method = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", method) as archive:
        warnings.simplefilter("ignore")
        for name, data in entries:
            archive.writestr(name, data)
    changed = bytearray(file.getvalue())
    if rng.random() < 0.2:  # Sizes, methods and flags in the central directory.
        at = changed.rfind(b"PK\x01\x02")
        changed[at + rng.choice([8, 10, 20, 24, 28, 42])] ^= 1 << rng.randrange(8)
    return bytes(changed)


def change_npy_header(data: bytes, rng: random.Random) -> bytes:
    end = data.find(b"}") + 1
    start = data.find(b"{")
    if start < 0 or rng.random() < 0.3:
        return change_bytes(data[:128], rng) + data[128:]
    shapes = ["()", "(0,)", "(1,)", "(-1,)", "(2**62,)", "(99999999999,)", "(4, 4)", "(1e3,)", "None", "(True,)"]
    kinds = ["|O", "<f8", ">i4", "|u1", "<U4", "|V8", "<c16", "<f2", "object", "M8[D]", "|S9999999"]
    order = rng.choice(["True", "False", "1"])
    text = f"{{'descr': '{rng.choice(kinds)}', 'fortran_order': {order}, 'shape': {rng.choice(shapes)}, }}"
    padded = text.encode().ljust(end - start)[: end - start] if rng.random() < 0.5 else text.encode()
    return data[:start] + padded + data[end:]


def change_text(content: bytes, rng: random.Random) -> bytes:
    """Change numbers, words, lines and elements of a text."""
    text = content.decode("utf-8", "replace")
    kind = rng.choice(["number"] * 4 + ["bytes", "line", "element", "entity", "nest"])
    if kind == "bytes":
        return change_bytes(content, rng)
    if kind == "number":
        words = list(re.finditer(r"-?\d+(\.\d+)?(e[+-]?\d+)?", text))
        for word in rng.sample(words, min(len(words), rng.choice([1, 1, 5]))):
            text = text[: word.start()] + str(rng.choice(VALUES)) + text[word.end() :]
            break
    elif kind == "line":
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        lines[at : at + rng.choice([0, 1])] = [lines[rng.randrange(len(lines))]] * rng.choice([0, 1, 2])
        text = "\n".join(lines)
    elif kind == "element":
        tags = re.findall(r"<(\w+)>", text)
        if tags:
            tag = rng.choice(tags)
            text = re.sub(
                rf"<{tag}>.*?</{tag}>",
                rng.choice(["", f"<{tag}/>", f"<{tag}>x</{tag}>", r"\g<0>\g<0>"]),
                text,
                count=1,
                flags=re.S,
            )
    elif kind == "entity":
        text = '<!DOCTYPE x [<!ENTITY a "&#60;b/&#62;"><!ENTITY b SYSTEM "file:///etc/passwd">]>' + text.replace(
            "<label>", "<label>&b;", 1
        )
    else:
        text = text.replace("<transform", "<x>" * 5000 + "<transform", 1)
    return text.encode("utf-8", "replace")


def write_feather(table: pa.Table) -> bytes:
    file = io.BytesIO()
    pyarrow.feather.write_feather(table, file)
    return file.getvalue()
