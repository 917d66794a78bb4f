"""What several tests of the loop stand on."""

from __future__ import annotations

import os
import socket
import time
import tty
from collections.abc import Iterator
from contextlib import closing

import pytest

from dreamer_racing.hil.inlet import RECEIVED_AT, UdpInlet


@pytest.fixture
def kernel_stamps() -> Iterator[None]:
    """A kernel that notes when datagrams arrive: it begins to a moment after the first socket has asked for it.

    Until then it gives the time of reading (Linux's ``net_enable_timestamp`` leaves the switch to a worker).
    """
    with closing(UdpInlet(0)) as inlet, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(1000 if RECEIVED_AT is not None else 0):
            sender.sendto(b"now", inlet.address)
            sent = time.monotonic()
            time.sleep(0.01)
            if any(arrived < sent + 5e-3 for arrived, _ in inlet.read()):
                break
        else:
            assert RECEIVED_AT is None, "the kernel does not say when datagrams arrive"
        yield  # the inlet asks as long as the test runs


class Clock:
    """A clock that a test turns."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """A free UDP port of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(5.0)
        yield listening


@pytest.fixture
def wire() -> Iterator[tuple[int, str]]:
    """The far end of a serial line, and the path of the near one."""
    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    for descriptor in (far, near):
        os.close(descriptor)
