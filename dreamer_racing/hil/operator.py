"""The operator of a flight: the person who enables the vehicle, and may stop it at any time.

For a flight with ``operator=udp``, start a switch in a terminal of the operator's machine:

    python -m dreamer_racing.hil.operator --host 192.168.1.20       # e: the enable; any other key, or Ctrl-C: kill
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import socket
import sys
import time
from collections.abc import Callable
from typing import IO, Any, NamedTuple, Protocol

from dreamer_racing.hil.inlet import UdpInlet
from dreamer_racing.hil.packets import PacketFormat

PACKET = PacketFormat(b"DRO1", "IBB")  # sequence number u32, enable u8, kill u8

PORT = 9102
DEAD_MAN = 0.5  # s without a packet after which the enable counts as released [choice]; send ten a second or more
SEND_RATE = 20.0  # Hz at which the switch of this file sends [choice]
KILLS = 20  # kill packets that the switch sends before it ends [choice]: radios lose some

logger = logging.getLogger(__name__)


class Operator(NamedTuple):
    """What the operator wants."""

    enable: bool  # the vehicle may fly
    kill: bool  # motors off, now and for good


class OperatorSource(Protocol):
    """A source of the operator's enable and kill."""

    def poll(self, armed: bool = False) -> Operator:
        """Return the operator's wish, without blocking; ``armed``: whether the vehicle is, since the tick before."""

    def close(self) -> None:
        """Release the socket or terminal; may be called twice."""


def encode_operator(sequence: int, operator: Operator) -> bytes:
    """Return the bytes of a packet."""
    return PACKET.pack(sequence % 2**32, *operator)


def decode_operator(data: bytes) -> tuple[int, Operator] | None:
    """Return a packet's sequence number and content; None if it is not such a packet, or damaged."""
    content = PACKET.unpack(data)
    if content is None or max(content[1:]) > 1:
        return None
    sequence, enable, kill = content
    return sequence, Operator(bool(enable), bool(kill))


class UdpOperator:
    """A switch on the network. A kill is latched; an enable lapses when packets stop.

    Attributes:
        rejected: Number of datagrams that were invalid, or older than one before. A switch that restarts its numbers
            needs a new flight.
    """

    def __init__(self, port: int, host: str = "127.0.0.1", clock: Callable[[], float] = time.monotonic) -> None:
        self.rejected = 0
        self._inlet = UdpInlet(port, host)
        self.address = self._inlet.address
        self._clock = clock
        self._wish = Operator(False, False)
        self._heard = -DEAD_MAN
        self._sequence: int | None = None

    def poll(self, armed: bool = False) -> Operator:
        """Return the operator's wish, without blocking."""
        for _, data in self._inlet.read():
            self._take(decode_operator(data))
        alive = self._clock() - self._heard < DEAD_MAN
        return Operator(self._wish.enable and alive, self._wish.kill)

    def _take(self, packet: tuple[int, Operator] | None) -> None:
        if packet is None:
            self.rejected += 1
            return
        sequence, will = packet
        # A kill counts whatever its number; an enable that is not newer may be replayed.
        replayed = self._sequence is not None and (sequence - self._sequence - 1) % 2**32 >= 2**31
        if replayed:
            self.rejected += 1
        else:
            self._sequence, self._heard = sequence, self._clock()
        self._wish = Operator(self._wish.enable if replayed else will.enable, self._wish.kill or will.kill)

    def close(self) -> None:
        """Close the socket."""
        self._inlet.close()


class KeyboardOperator:
    """Reads keys from the terminal: ``e`` toggles the enable; any other key kills.

    Raises:
        OSError: There is no terminal.
    """

    def __init__(self, terminal: IO[str] | None = None) -> None:
        import select
        import termios
        import tty

        self._terminal = sys.stdin if terminal is None else terminal
        if not self._terminal.isatty():
            raise OSError("operator=keyboard needs a terminal to read keys from: use operator=udp.")
        self._select, self._termios = select.select, termios
        self._before: list[Any] | None = termios.tcgetattr(self._terminal)
        tty.setcbreak(self._terminal)
        self._wish = Operator(False, False)

    def poll(self, armed: bool = False) -> Operator:
        """Return the operator's wish, without blocking."""
        if self._select([self._terminal], [], [], 0.0)[0]:
            try:
                keys = os.read(self._terminal.fileno(), 1024)  # bypasses Python's buffer, which select does not see
            except OSError:
                keys = b""  # the terminal is gone
            enable = self._wish.enable ^ bool(keys.count(b"e") % 2)
            self._wish = Operator(enable, self._wish.kill or not keys or bool(keys.strip(b"e")))
        return self._wish

    def close(self) -> None:
        """Restore the terminal's settings."""
        if self._before is not None:
            with contextlib.suppress(self._termios.error):  # the terminal was closed
                self._termios.tcsetattr(self._terminal, self._termios.TCSADRAIN, self._before)
            self._before = None


def is_remote_terminal() -> bool:
    """Return whether the terminal seems to be at the other end of a network; ``sudo`` and ``tmux`` may hide it."""
    return bool(os.environ.get("SSH_CONNECTION"))


def send_operator(source: OperatorSource, send: Callable[[bytes], object], sleep: Callable[[float], None]) -> None:
    """Send an operator's wish until it is a kill, then the kill for a while; Ctrl-C is a kill, too.

    Packets are numbered by the clock, so that a restarted switch continues the sequence.
    """
    number, left, wish, said = int(SEND_RATE * time.time()), KILLS, Operator(False, False), ""
    while left:
        try:
            wish = wish if wish.kill else source.poll()
            word = "kill" if wish.kill else "the enable is given" if wish.enable else "no enable"
            try:
                send(encode_operator(number, wish))
                left -= wish.kill
            except OSError as error:  # the network may come back; the enable lapses meanwhile, and a kill is kept
                word = f"{word}, but it could not be sent: {error}"
            if word != said:
                logger.info(word)
                said = word
            number += 1
            sleep(1.0 / SEND_RATE)
        except KeyboardInterrupt:
            wish = Operator(False, True)


def main() -> None:
    """Send the enable, and a kill, of the keyboard here to a flight with operator=udp."""
    parser = argparse.ArgumentParser(prog="python -m dreamer_racing.hil.operator", description=main.__doc__)
    parser.add_argument("--host", required=True, help="address of recipes/hil.py; set operator_host= to it there")
    parser.add_argument("--port", type=int, default=PORT, help="the same as operator_port= there")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    if is_remote_terminal():
        parser.exit(2, "This terminal uses an ssh connection, which may drop: run this on your own machine.\n")
    try:
        address = socket.gethostbyname(arguments.host), arguments.port
        keyboard = KeyboardOperator()
    except OSError as error:
        parser.exit(2, f"{arguments.host}: {error}\n")
    logger.info("e: give the enable, and again: take it back; any other key: kill. Sends to %s:%d", *address)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as switch, contextlib.closing(keyboard):
        send_operator(keyboard, lambda data: switch.sendto(data, address), time.sleep)


class TimedOperator:
    """Toggles the enable automatically until the vehicle is armed: for simulated vehicles, never for real ones.

    It is released, and then given, for ``delay`` s each.
    """

    def __init__(self, delay: float = 0.5, clock: Callable[[], float] = time.monotonic) -> None:
        self._delay, self._clock = delay, clock
        self._from: float | None = None
        self._armed = False

    def poll(self, armed: bool = False) -> Operator:
        """Return the present enable, which stays once the vehicle is armed."""
        now = self._clock()
        if self._from is None:
            self._from = now
        self._armed = self._armed or armed
        return Operator(self._armed or (now - self._from) % (2 * self._delay) >= self._delay, False)

    def close(self) -> None:
        """Do nothing."""


if __name__ == "__main__":
    main()
