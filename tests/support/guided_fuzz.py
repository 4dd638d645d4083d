"""Fuzzing guided by coverage: inputs that reach a new step from line to line are kept and changed further.

After the idea of AFL (Zalewski, 2013); small, so that it needs nothing that is not here already.
"""

import random
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

_NOTEWORTHY = (b"\x00", b"\xff", b"\x7f\xff", b"\xff" * 4, b"\xff" * 8, b"\x00" * 8, b"\x80\x00\x00\x00")

Mutation = Callable[[bytes, random.Random], bytes]


class Target(NamedTuple):
    """What is fuzzed.

    Attributes:
        check: raises where something is wrong.
        seeds: inputs to begin with.
        modules: the files (their full names) whose steps count as coverage.
        mutations: ways to change an input that suit its format, besides the common ones.
        longest: bytes of an input; what is longer is cut.
    """

    check: Callable[[bytes], None]
    seeds: Sequence[bytes]
    modules: Sequence[str | None]
    mutations: Sequence[Mutation]
    longest: int = 4096


@dataclass
class Findings:
    """What a session of fuzzing did."""

    runs: int
    corpus: list[bytes]
    edges: int


def fuzz(
    target: Target, seed: int, *, runs: int | None = None, seconds: float | None = None, folder: Path | None = None
) -> Findings:
    """Feeds changed inputs until one is found that something is wrong with, or the runs or seconds are over.

    Args:
        target: takes the inputs.
        seed: of the random numbers.
        runs: how many inputs.
        seconds: how long.
        folder: where an input that makes it raise is put.
    """
    chance = random.Random(seed)
    corpus, edges, n = list(target.seeds), set(), 0
    for each in corpus:
        edges |= _trace(target, each, folder)
    end_s = time.monotonic() + seconds if seconds is not None else float("inf")
    while (runs is None or n < runs) and time.monotonic() < end_s:
        n += 1
        data = _change(corpus, chance, target.mutations)[: target.longest]
        found = _trace(target, data, folder)
        if not found <= edges:
            edges |= found
            corpus.append(data)
    return Findings(n, corpus, len(edges))


def _change(corpus: Sequence[bytes], chance: random.Random, mutations: Sequence[Mutation]) -> bytes:
    data = chance.choice(corpus)
    for _ in range(1 << chance.randrange(4)):
        if mutations and chance.random() < 0.5:
            data = chance.choice(mutations)(data, chance)
        else:
            data = _common(data, corpus, chance)
    return data


def _common(data: bytes, corpus: Sequence[bytes], chance: random.Random) -> bytes:
    at, length = chance.randrange(len(data) + 1), chance.choice((1, 2, 4, 8, 32, 128))
    kind = chance.randrange(7)
    if kind == 0 and data:
        at = min(at, len(data) - 1)
        return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + data[at + length :]
    if kind == 2:
        return data[:at] + chance.randbytes(length) + data[at + length :]
    if kind == 3:
        return data[:at] + data[at : at + length] * 2 + data[at + length :]
    if kind == 4:
        other = chance.choice(corpus)
        return data[:at] + other[chance.randrange(len(other) + 1) :]
    if kind == 5:
        return data[:at] + chance.choice(_NOTEWORTHY) + data[at:]
    moved = chance.randrange(len(data) + 1)
    return data[:moved] + data[at : at + length] + data[moved:]


def _trace(target: Target, data: bytes, folder: Path | None) -> set[tuple[object, int, int]]:
    edges: set[tuple[object, int, int]] = set()

    def local(frame: FrameType) -> Callable[[FrameType, str, Any], Any]:
        last = 0

        def each_line(_frame: FrameType, event: str, _argument: Any) -> Any:
            nonlocal last
            if event == "line":
                edges.add((frame.f_code, last, frame.f_lineno))
                last = frame.f_lineno
            return each_line

        return each_line

    def each_call(frame: FrameType, _event: str, _argument: Any) -> Any:
        return local(frame) if frame.f_code.co_filename in target.modules else None

    before = sys.gettrace()
    sys.settrace(each_call)
    try:
        target.check(data)
    except BaseException:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{abs(hash(data)):016x}.bin").write_bytes(data)
        raise
    finally:
        sys.settrace(before)
    return edges
