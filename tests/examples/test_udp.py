"""The example that sends head and wrists, as `memmlp live` reads them."""

import socket
import subprocess
import sys

import pytest
from examples.conftest import EXAMPLES

from memmlp.live.session.sources import parse_json_packet

SEND = EXAMPLES / "udp/send.py"


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
