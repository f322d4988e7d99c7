"""Sends packets of head and wrists to `memmlp live`, with Python alone.

    memmlp live RUN --udp 9100 --space openxr
    python send.py --port 9100

A person stands in a T-pose, lowers the arms, and sways. The axes are OpenXR's: right-handed, Y up, -Z
forward, metres. A rotation is a joint's turn from the T-pose, as quaternion x y z w.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import socket
import time

HEAD = (0.0, 1.55, 0.0)  # the base of the skull, not the headset
SHOULDER, ARM = (0.18, 1.42, 0.0), 0.52  # the right one's place, and from there to the wrist
RATE = 60


def packet(seconds: float) -> dict[str, object]:
    """The trackers at a time: the arms go down within two seconds, the whole person sways by 10 cm."""
    down = math.radians(80) * min(1.0, seconds / 2)
    sway = 0.1 * math.sin(seconds)
    head = [HEAD[0] + sway, *HEAD[1:], 0.0, 0.0, 0.0, 1.0]
    return {"time": seconds, "head": head, "left": wrist(-1, down, sway), "right": wrist(1, down, sway)}


def wrist(side: int, down: float, sway: float) -> list[float]:
    """The left (-1) or right (1) wrist of an arm that is turned down from the T-pose by so many radians.

    Turned by 90 degrees about the forward axis, the left arm's -X becomes -Y: it hangs.
    """
    x = side * (SHOULDER[0] + ARM * math.cos(down)) + sway
    turn = -side * down / 2
    return [x, SHOULDER[1] - ARM * math.sin(down), SHOULDER[2], 0.0, 0.0, math.sin(turn), math.cos(turn)]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Sends packets of a made-up person's head and wrists.")
    made.add_argument("--host", default="127.0.0.1", help="where memmlp live runs")
    made.add_argument("--port", type=int, default=9100, help="its UDP port")
    made.add_argument("--seconds", type=float, default=math.inf, help="how long; by default until Ctrl-C")
    return made


def main() -> None:
    """Send a packet for each frame."""
    asked = parser().parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        began, frame = time.monotonic(), 0
        while frame / RATE < asked.seconds:
            sender.sendto(json.dumps(packet(frame / RATE)).encode(), (asked.host, asked.port))
            frame += 1
            time.sleep(max(0.0, began + frame / RATE - time.monotonic()))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
