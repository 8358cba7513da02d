"""Damage to files: bits, lengths, numbers in binary and in text, nesting, blocks out of place."""

import random
import re
import struct
from collections.abc import Callable

EXTREMES = (
    0, 1, -1, 2, 7, 127, 128, 255, 256, 32767, 65535, 65536, 2**31 - 1, -(2**31), 2**32 - 1,
    2**53, 2**63 - 1, -(2**63), 2**63, 2**64 - 1,
)  # fmt: skip
FLOATS = (0.0, -0.0, 1e-320, 1e-30, 1e10, 1e30, 1e154, 1e300, -1e300, float("inf"), float("nan"))
WORDS = (
    b"", b"0", b"-1", b"1e400", b"nan", b"inf", b"NaN", b"Infinity", b"null", b"true", b"[]", b"{}",
    b"9" * 20, b"9" * 5000, b"-" + b"9" * 5000, b"1e-400", b'"x"', b"\xff\xfe", b"0x10", b"1_0",
    b"&a [*a]", b"*a", b".inf", b"-.inf", b"1e400,", b"\x1b[31m",
    b"[" * 5000, b'{"a":' * 5000, b"\xb2", b"../../x", b"..", b"\0",
)  # fmt: skip
NUMBER = re.compile(rb"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?")
WORD = re.compile(rb"[^\s,:\[\]{}\"']+")


def flip(rng: random.Random, data: bytearray) -> None:
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def cut(rng: random.Random, data: bytearray) -> None:
    del data[rng.randrange(len(data)) :]


def extend(rng: random.Random, data: bytearray) -> None:
    data += rng.choice((b"\0", b"\n", rng.randbytes(8), rng.randbytes(4096)))


def drop(rng: random.Random, data: bytearray) -> None:
    start = rng.randrange(len(data))
    del data[start : start + rng.choice((1, 2, 4, 8, 64))]


def repeat(rng: random.Random, data: bytearray) -> None:
    start = rng.randrange(len(data))
    data[start:start] = data[start : start + rng.choice((1, 4, 8, 64))] * rng.choice((1, 2, 50))


def swap(rng: random.Random, data: bytearray) -> None:
    size = rng.choice((1, 4, 8, 24))
    one, two = rng.randrange(len(data)), rng.randrange(len(data))
    first, second = bytes(data[one : one + size]), bytes(data[two : two + size])
    if len(first) == len(second):
        data[one : one + size], data[two : two + size] = second, first


def integer(rng: random.Random, data: bytearray) -> None:
    """An integer of some width, at the head more often than elsewhere, becomes an extreme one."""
    width = rng.choice((1, 2, 4, 8))
    start = rng.randrange(min(len(data), rng.choice((16, 64, 1 << 20))))
    value = rng.choice(EXTREMES) % (1 << 8 * width)
    order = rng.choice(("little", "big"))
    data[start : start + width] = value.to_bytes(width, order)


def real(rng: random.Random, data: bytearray) -> None:
    kind = rng.choice(("<f", "<d", ">f"))
    value = rng.choice(FLOATS)
    if kind != "<d" and abs(value) > 1e38:
        value = float("inf")
    start = rng.randrange(len(data))
    packed = struct.pack(kind, value)
    data[start : start + len(packed)] = packed


def number(rng: random.Random, data: bytearray) -> None:
    _replace(rng, data, NUMBER)


def word(rng: random.Random, data: bytearray) -> None:
    _replace(rng, data, WORD)


def _replace(rng: random.Random, data: bytearray, pattern: re.Pattern[bytes]) -> None:
    found = list(pattern.finditer(bytes(data[: 1 << 16])))
    if found:
        match = rng.choice(found)
        data[match.start() : match.end()] = rng.choice(WORDS)


def line(rng: random.Random, data: bytearray) -> None:
    lines = bytes(data).split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(3):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, rng.choice(lines))
        case _:
            rng.shuffle(lines)
    data[:] = b"\n".join(lines)


def replace(rng: random.Random, data: bytearray) -> None:
    data[:] = rng.choice((b"", b"\0", rng.randbytes(64), *WORDS))


MUTATIONS: tuple[Callable[[random.Random, bytearray], None], ...] = (
    *(flip, flip, cut, extend, drop, repeat, swap, integer, integer, integer, real, real),
    *(number, number, number, word, word, line, replace),
)


def mutated(rng: random.Random, data: bytes) -> bytes:
    """The content of a file with one or two kinds of damage."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2))):
        if result:
            rng.choice(MUTATIONS)(rng, result)
    return bytes(result)
