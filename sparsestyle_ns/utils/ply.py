"""PLY files (Turk 1994): written in binary, and told from those that are cut short."""

import struct
from pathlib import Path
from typing import BinaryIO, List, Sequence, Tuple

import numpy as np

SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
"""Bytes of a number, by the names that the format has for kinds of them."""
RGB = ("uchar red", "uchar green", "uchar blue")
"""How the format declares colours."""
COUNTS = {1: "B", 2: "H", 4: "I"}
LONGEST_HEADER = 1 << 16
"""Bytes."""


def encode_ply(*elements: Tuple[str, Sequence[str], np.ndarray]) -> bytes:
    """A binary PLY file.

    Args:
        elements: of each its name, what a row holds as the format declares it, such as `float x` or `list uchar int
            vertex_indices`, and the rows as they go into the file, little-endian.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, properties, rows in elements:
        lines += [f"element {name} {len(rows)}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header", ""]).encode() + b"".join(rows.tobytes() for *_, rows in elements)


def floats(*names: str) -> Tuple[str, ...]:
    """How the format declares numbers of four bytes with these names."""
    return tuple(f"float {name}" for name in names)


def is_whole_ply(path: Path) -> bool:
    """Whether a PLY file has all that its header announces; lists are taken to be as long as the first, as triangles
    are."""
    with path.open("rb") as file:
        header, found, _ = file.read(LONGEST_HEADER).partition(b"end_header\n")
        if not found or not header.startswith(b"ply"):
            return False
        elements = _elements(header.decode("ascii", "replace").splitlines())
        file.seek(len(header) + len(found))
        if b"format ascii" in header:
            rest = file.read()
            return rest.endswith(b"\n") and rest.count(b"\n") >= sum(count for count, _ in elements)
        order, end = "<>"[b"big_endian" in header], file.tell()
        for count, properties in elements:
            file.seek(end)
            end += count * _row_size(file, properties, order) if count else 0
        return path.stat().st_size >= end


def _elements(lines: Sequence[str]) -> List[Tuple[int, List[List[str]]]]:
    """Of each element how many rows it has, and what its properties are."""
    elements: List[Tuple[int, List[List[str]]]] = []
    for words in map(str.split, lines):
        if words[:1] == ["element"]:
            elements.append((int(words[2]), []))
        if words[:1] == ["property"]:
            elements[-1][1].append(words[1:])
    return elements


def _row_size(file: BinaryIO, properties: Sequence[Sequence[str]], order: str) -> int:
    """Bytes of the row at which a file stands."""
    start = file.tell()
    for kind, *more in properties:
        if kind != "list":
            file.seek(SIZES[kind], 1)
            continue
        read = file.read(SIZES[more[0]])
        if len(read) == SIZES[more[0]]:
            file.seek(struct.unpack(order + COUNTS[len(read)], read)[0] * SIZES[more[1]], 1)
    return file.tell() - start
