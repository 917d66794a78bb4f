"""What several tests of the loop stand on."""

from __future__ import annotations

import socket
import time

import pytest

from dreamer_racing.hil.inlet import RECEIVED_AT, UdpInlet


@pytest.fixture
def kernel_stamps():
    """A kernel that notes when datagrams arrive: it begins to a moment after the first socket has asked for it.

    Until then it gives the time of reading (Linux's ``net_enable_timestamp`` leaves the switch to a worker).
    """
    inlet = UdpInlet(0)  # asks as long as the test runs
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(1000):
            sender.sendto(b"now", inlet.address)
            sent = time.monotonic()
            time.sleep(0.01)
            ((arrived, _),) = inlet.read()
            if arrived < sent + 5e-3 or RECEIVED_AT is None:
                break
    yield
    inlet.close()
