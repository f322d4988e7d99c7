"""The example that sends head and wrists, as `memmlp live` reads them."""

import runpy
import socket
import subprocess
import sys

import numpy as np
import pytest
from examples.conftest import EXAMPLES
from scipy.spatial.transform import Rotation

from memmlp.live.session.sources import parse_json_packet

SEND = EXAMPLES / "udp/send.py"
sender = runpy.run_path(str(SEND))


def test_wrists_turn_as_the_arms_do():
    for seconds in (0.0, 0.7, 9.0):
        made = sender["packet"](seconds)
        for name, side in (("left", -1), ("right", 1)):
            values = np.array(made[name])
            shoulder = np.array([side * sender["SHOULDER"][0] + made["head"][0], *sender["SHOULDER"][1:]])
            along = Rotation.from_quat(values[3:]).apply([side, 0, 0])
            np.testing.assert_allclose(values[:3], shoulder + sender["ARM"] * along, atol=1e-12)
        assert made["left"][1] < 1.0 or seconds < 2


@pytest.mark.slow
def test_it_sends_what_live_takes():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(60)
        port = listener.getsockname()[1]
        subprocess.run(
            [sys.executable, str(SEND), "--port", str(port), "--seconds", "0.1"], check=True, timeout=60
        )
        packets = [parse_json_packet(listener.recv(65536)) for _ in range(6)]
    assert [packet.time for packet in packets] == pytest.approx([frame / 60 for frame in range(6)])
    assert all(tracker is not None for packet in packets for tracker in packet.trackers)
