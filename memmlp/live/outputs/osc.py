"""OSC bundles that are sent sixty times a second: python-osc lays them out once, then only floats change.

Every element of a bundle is at a multiple of four bytes (Open Sound Control 1.0), so its floats are elements
of one array of big-endian float32.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from memmlp.common.errors import InputError

WORD = 4  # bytes
HEADER = 16  # bytes of a bundle before its first message
LARGEST = 1472  # bytes of a datagram that an Ethernet packet holds, so that none is split


class Message(NamedTuple):
    """A message whose last arguments are floats.

    Attributes:
        address: the message's OSC address.
        fixed: the arguments before the floats, each an integer or a text.
        floats: how many floats follow.
    """

    address: str
    fixed: Sequence[int | str] = ()
    floats: int = 0


class Bundle:
    """A bundle of messages with a fixed layout.

    Args:
        messages: the messages; `write` takes their floats in this order.
    """

    def __init__(self, messages: Sequence[Message]):
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import OscMessageBuilder

        bundle, places, end = OscBundleBuilder(IMMEDIATELY), [], HEADER
        for message in messages:
            builder = OscMessageBuilder(message.address)
            for value in message.fixed:
                builder.add_arg(value, "i" if isinstance(value, int) else "s")
            for _ in range(message.floats):
                builder.add_arg(0.0, "f")
            built = builder.build()
            bundle.add_content(built)
            end += WORD + len(built.dgram)
            places.append(end // WORD - np.arange(message.floats, 0, -1))
        self.data = np.frombuffer(bytearray(bundle.build().dgram), ">f4")
        self.places = np.concatenate(places).astype(int)

    def write(self, values: np.ndarray) -> bytes:
        """Return the bundle's datagram with these floats."""
        self.data[self.places] = values
        return self.data.tobytes()


class Receiver:
    """A program that takes datagrams at an address; it need not be running.

    Args:
        host: the program's host name or address.
        port: its UDP port.
        key: the option by which the user named it.

    Raises:
        InputError: for an unknown host name.
    """

    def __init__(self, host: str, port: int, key: str):
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{key} {host}: {reason}; allowed is HOST or HOST:PORT") from None
        self.address: tuple[Any, ...] = address
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def __str__(self) -> str:
        return f"{self.address[0]}:{self.address[1]}"

    def send(self, datagram: bytes) -> None:
        """Send a datagram, or drop it if the network is busy.

        Raises OSError if the address can't be reached.
        """
        try:
            self.socket.sendto(datagram, self.address)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                raise

    def close(self) -> None:
        """Release the socket."""
        self.socket.close()
