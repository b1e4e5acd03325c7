"""Ways to damage a file: its bytes, its words, its tree, its header."""

import ast
import json
import re
import struct
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

import yaml

Damage = Callable[[bytes, Random], bytes]

WORDS = (
    "0", "-1", "nan", "inf", "-inf", "1e308", "-1e308", "1e999", "1e-320", "9" * 30, "9" * 400,
    "-" + "9" * 400, "9" * 5000, "4294967295", "9223372036854775808", "2147483648", "0x10", "1_0",
    "", "true", "True", "null", "--1", "²", "é", "[]", "{}", "[[", "*a", "&a", "\x00", "1e", ".",
    "%",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, "", "x", "²", "1", "nan", [], {}, [[]], [None], {"a": 1}, 0, -1, 1, 0.5,
    -0.0, 1e308, -1e308, 1e-320, 2**31, 2**32, 2**63, 2**64, -(2**63) - 1, 10**30, 10**400,
    float("nan"), float("inf"), [1] * 9, [[1, 2], [3]], [1e308] * 9, [10**400] * 9, "a" * 5000,
    [[[[[[[[[[0]]]]]]]]]],
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|\w+")


def hurt_bytes(good: bytes, random: Random) -> bytes:  # noqa: PLR0911 - one a kind of damage
    """Cut, flip, overwrite, repeat, leave out, or keep the first bytes alone."""
    at, size = random.randrange(len(good)), random.choice((1, 2, 4, 8, 64))
    match random.randrange(8):
        case 0:
            return good[:at]
        case 1 | 2:
            data = bytearray(good)
            for _ in range(random.choice((1, 1, 2, 8))):
                data[random.randrange(min(len(data), 4096))] ^= 1 << random.randrange(8)
            return bytes(data)
        case 3:
            return good[:at] + random.choice((b"\xff", b"\x00", b"\x7f")) * size + good[at + size :]
        case 4:
            return good[: at + size] + good[at:]
        case 5:
            return good[:at] + good[at + size :]
        case 6:
            return good[: random.choice((0, 4, 16, 64))] + random.randbytes(random.randrange(200))
        case _:
            word = random.choice(WORDS).encode()
            return good[:at] + word + good[at + len(word) :]


def hurt_text(good: bytes, random: Random) -> bytes:
    """Change a word, or lines; now and then bytes."""
    kind = random.randrange(8)
    if kind == 0:
        return hurt_bytes(good, random)
    if kind <= 5:
        for _ in range(random.choice((1, 1, 2, 5))):
            found = list(_NUMBER.finditer(good))
            if not found:
                break
            word = random.choice(found)
            good = good[: word.start()] + random.choice(WORDS).encode() + good[word.end() :]
        return good
    lines = good.split(b"\n")
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    if kind == 6:
        lines[at : at + 1] = random.choice(([], [lines[at]] * 2, [lines[at]] * 200, [b""] * 50))
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)


def hurt_tree(tree: Any, random: Random) -> Any:  # noqa: ANN401 - one branch a kind of damage
    """Replace, leave out, rename or repeat something of JSON or YAML, in place; give it."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:  # noqa: ANN401
        keys = list(node) if isinstance(node, dict) else range(len(node))
        for key in keys:
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(tree)
    if not places or random.random() < 0.03:
        return random.choice(VALUES)
    for _ in range(random.choice((1, 1, 1, 3))):
        node, key = random.choice(places)
        if (isinstance(node, dict) and key not in node) or (
            isinstance(node, list) and key >= len(node)
        ):
            continue
        kind = random.randrange(10)
        if kind < 7:
            node[key] = random.choice(VALUES)
        elif kind == 7:
            del node[key]
        elif isinstance(node, dict):
            node[random.choice(("x", "", "-1", "²", "9" * 400, "1e3"))] = node.pop(key)
        else:
            node += [node[key]] * random.choice((1, 100))
    return tree


def hurt_json(good: bytes, random: Random) -> bytes:
    """Damage the tree, or the text."""
    if random.random() < 0.2:
        return hurt_text(good, random)
    if random.random() < 0.03:
        return random.choice((b"[" * 100_000, b'{"a":' * 50_000, b"9" * 5000, b'"' * 9))
    return json.dumps(hurt_tree(json.loads(good), random)).encode()


def hurt_yaml(good: bytes, random: Random) -> bytes:
    """Damage the tree, or the text; or write what grows when it is read."""
    if random.random() < 0.4:
        return hurt_text(good, random)
    if random.random() < 0.05:
        bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n"
        for one, other in zip("abcdefgh", "bcdefghi", strict=True):
            bomb += f"{other}: &{other} [{','.join([f'*{one}'] * 9)}]\n"
        return random.choice((bomb.encode(), b"[" * 20_000, b"a: " * 20_000, b"- " * 20_000))
    return yaml.safe_dump(hurt_tree(yaml.safe_load(good), random)).encode()


def hurt_npy(good: bytes, random: Random) -> bytes:
    """Write another header over an NPY file's."""
    if random.random() < 0.4:
        return hurt_bytes(good, random)
    (size,) = struct.unpack("<H", good[8:10])
    header, body = ast.literal_eval(good[10 : 10 + size].decode()), good[10 + size :]
    odd = (
        (1,) * 70,
        (True, 3),
        (10**30, 1),
        (0, 10**30),
        (-1, -3),
        (2.5,),
        (10**400, 0),
        (),
        ((3,),),
    )
    header[random.choice(("shape", "shape", "descr", "fortran_order"))] = random.choice(
        (
            *odd,
            *odd,
            "<f4",
            "<f2",
            "|b1",
            "<c16",
            "|O",
            "<f16",
            "|S4",
            [("a", "<f4")],
            True,
            1,
            None,
        )
    )
    if random.random() < 0.1:
        header.pop(random.choice(list(header)))
    text = repr(header).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def hurt_png(good: bytes, random: Random) -> bytes:
    """Change fields of a PNG's chunks and mend their checksums; or its bytes."""
    if random.random() < 0.4:
        return hurt_bytes(good, random)
    chunks = png_chunks(good)
    at = random.randrange(len(chunks))
    kind, data = chunks[at]
    match random.randrange(4):
        case 0:
            chunks[0] = (b"IHDR", _hurt_header(chunks[0][1], random))
        case 1:
            chunks[at] = (kind, hurt_bytes(data or b"\x00", random))
        case 2:
            chunks[at : at + 1] = random.choice(([], [chunks[at]] * 3))
        case _:
            other = (random.choice((b"tRNS", b"PLTE", b"eXIf", b"zTXt", b"gAMA", b"acTL")),
                     random.randbytes(random.randrange(40)))  # fmt: skip
            chunks.insert(random.randrange(len(chunks)), other)
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*chunk) for chunk in chunks)


def _hurt_header(data: bytes, random: Random) -> bytes:
    width, height, *rest = struct.unpack(">IIBBBBB", data)
    size = random.choice((0, 1, width, 60_000, 8192, 2**31 - 1, 2**32 - 1))
    fields = [width, height, *rest]
    place = random.randrange(7)
    fields[place] = size if place < 2 else random.choice((0, 1, 2, 3, 4, 6, 7, 16, 255))
    return struct.pack(">IIBBBBB", *fields)


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Take a PNG apart."""
    chunks, at = [], 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return chunks


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """Write a chunk with its checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def hurt_safetensors(good: bytes, random: Random) -> bytes:
    """Damage the header, the config inside it, or the bytes."""
    if random.random() < 0.25:
        return hurt_bytes(good, random)
    (size,) = struct.unpack("<Q", good[:8])
    header, body = json.loads(good[8 : 8 + size]), good[8 + size :]
    held = header.get("__metadata__", {})
    if "config" in held and random.random() < 0.6:
        held["config"] = json.dumps(hurt_tree(json.loads(held["config"]), random))
    else:
        header = hurt_tree(header, random)
    return pack_safetensors(header, body)


def pack_safetensors(header: object, body: bytes) -> bytes:
    """Put a header before the tensors."""
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def hurt_glb(good: bytes, random: Random) -> bytes:
    """Damage the scene of a GLB, or its bytes."""
    if random.random() < 0.3:
        return hurt_bytes(good, random)
    (size,) = struct.unpack("<I", good[12:16])
    tree, rest = hurt_tree(json.loads(good[20 : 20 + size]), random), good[20 + size :]
    return pack_glb(tree, rest)


def pack_glb(tree: object, rest: bytes = b"") -> bytes:
    """Put the JSON of a scene before its other chunks."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<II", len(text), 0x4E4F534A) + text
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunk) + len(rest)) + chunk + rest
