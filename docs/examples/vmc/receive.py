"""Prints hips and head, or all bones, from VMC packets, with Python alone.

    python receive.py --port 39539
    python receive.py --all

A line for each frame: x, y, z of hips and head, metres, in Unity's axes (left-handed, Y up); with --all those
of every bone that came. VMC (protocol.vmc.info/english) sends each bone's position and quaternion x y z w
relative to its parent's, as OSC messages in UDP datagrams: `/VMC/Ext/Bone/Pos` name, px, py, pz, qx, qy, qz,
qw.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any

BONE, ROOT = "/VMC/Ext/Bone/Pos", "/VMC/Ext/Root/Pos"
CHAINS = (  # from the root outward; a body may lack some
    ("root", "Hips", "Spine", "Chest", "UpperChest", "Neck", "Head"),
    *(("UpperChest", f"{s}Shoulder", f"{s}UpperArm", f"{s}LowerArm", f"{s}Hand") for s in ("Left", "Right")),
    *(("Hips", f"{s}UpperLeg", f"{s}LowerLeg", f"{s}Foot", f"{s}Toes") for s in ("Left", "Right")),
)
Vector = tuple[float, ...]


def messages(data: bytes) -> Iterator[tuple[str, list[Any]]]:
    """Yield address and values of each OSC message in a datagram, of bundles in bundles, too."""
    if not data.startswith(b"#bundle\0"):
        yield message(data)
        return
    at = 16  # behind "#bundle" and a time
    while at < len(data):
        (size,) = struct.unpack_from(">i", data, at)
        yield from messages(data[at + 4 : at + 4 + size])
        at += 4 + size


def message(data: bytes) -> tuple[str, list[Any]]:
    """Read one OSC message of numbers and strings."""
    address, at = text(data, 0)
    types, at = text(data, at)
    values: list[Any] = []
    for kind in types[1:]:
        if kind == "s":
            value, at = text(data, at)
            values.append(value)
        else:
            values += struct.unpack_from(f">{kind}", data, at)  # i, f and d are the same letters there
            at += struct.calcsize(kind)
    return address, values


def text(data: bytes, at: int) -> tuple[str, int]:
    """Read a string, and return where the next value begins: strings are padded to four bytes."""
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 4 - end % 4


def turned(quaternion: Vector, vector: Vector) -> Vector:
    """Turn a vector: v + 2 w (q x v) + 2 q x (q x v)."""
    *q, w = quaternion
    once = cross(q, vector)
    twice = cross(q, once)
    return tuple(v + 2 * w * a + 2 * b for v, a, b in zip(vector, once, twice, strict=True))


def cross(a: Any, b: Any) -> Vector:
    """The cross product, by the same formula in left-handed axes."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def product(a: Vector, b: Vector) -> Vector:
    """The turn b, then a."""
    vector = tuple(a[3] * y + b[3] * x + c for x, y, c in zip(a[:3], b[:3], cross(a, b), strict=True))
    return *vector, a[3] * b[3] - sum(x * y for x, y in zip(a[:3], b[:3], strict=True))


def places(bones: dict[str, Vector]) -> dict[str, Vector]:
    """Follow the bones from the root outward, and return where each is in the world."""
    found: dict[str, tuple[Vector, Vector]] = {}
    for first, *others in CHAINS:
        last = found.get(first) or found.get("Chest") or ((0, 0, 0), (0, 0, 0, 1))
        for name in (first, *others):
            if name in bones and name not in found:
                position, rotation = last
                away = turned(rotation, bones[name][:3])
                moved = tuple(a + b for a, b in zip(position, away, strict=True))
                found[name] = moved, product(rotation, bones[name][3:])
            last = found.get(name, last)
    return {name: position for name, (position, _) in found.items()}


def frames(listener: socket.socket) -> Iterator[dict[str, Vector]]:
    """Yield root and bones of each frame, which is over when one of them comes for the second time."""
    frame: dict[str, Vector] = {}
    while True:
        for address, values in messages(listener.recv(65536)):
            if address in (ROOT, BONE):
                name = values[0]
                if name in frame:
                    yield frame
                    frame = {}
                frame[name] = tuple(values[1:8])


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Prints hips and head, or all bones, from VMC packets.")
    made.add_argument("--port", type=int, default=39539, help="UDP port; 0 for any that is free")
    made.add_argument("--all", action="store_true", help="print every bone, a line for each frame")
    made.add_argument("--frames", type=int, help="how many to print; by default until Ctrl-C")
    return made


def main() -> None:
    """Listen on this machine, and print."""
    asked = parser().parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", asked.port))
        print(f"listening on UDP port {listener.getsockname()[1]}", file=sys.stderr, flush=True)
        for count, bones in enumerate(frames(listener), 1):
            found = places(bones)
            wanted = [name for name in found if asked.all or name in ("Hips", "Head")]
            lines = [" ".join([name, *(f"{x:.4f}" for x in found[name])]) for name in wanted]
            print("  ".join(lines), flush=True)
            if count == asked.frames:
                break


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
