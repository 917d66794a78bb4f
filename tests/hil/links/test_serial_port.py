"""Serial ports, over pairs of pseudo-terminals: frames arrive as they were sent, and nothing ever waits."""

from __future__ import annotations

import errno
import os
import select
import sys
import termios
import time
import tty
from dataclasses import replace

import pytest

serial = pytest.importorskip("serial")

from dreamer_racing.hil.links import LinkConfig, make_link  # noqa: E402
from dreamer_racing.hil.links.crsf import crc8  # noqa: E402
from dreamer_racing.hil.links.serial_port import PROTOCOLS, SerialPort, SerialSettings  # noqa: E402
from dreamer_racing.hil.vehicle import at_rest  # noqa: E402
from tests.hil.links.frames import RATES, RESTING, THRUST, read_channels, read_words  # noqa: E402

MSP = PROTOCOLS["msp"]


def read(descriptor: int, size: int) -> bytes:
    data = b""
    while len(data) < size and select.select([descriptor], [], [], 5.0)[0]:
        data += os.read(descriptor, size - len(data))
    return data


@pytest.mark.parametrize("name", ["crsf", "sbus", "msp", "msp_override"])
def test_frames_arrive(wire, name):
    far, path = wire
    link = make_link(LinkConfig(name, device=path, rates=RATES, thrust=THRUST))
    sent = link.send(at_rest())
    assert read(far, len(sent)) == sent
    channels = (*read_words(sent[5:13]), *RESTING[4:]) if name == "msp_override" else read_channels(name, sent)
    assert channels == pytest.approx(RESTING)
    link.close()
    link.close()


def test_the_battery_is_heard_on_the_same_wire(wire):
    far, path = wire
    link = make_link(LinkConfig("crsf", device=path, rates=RATES, thrust=THRUST))
    assert link.listen() == []
    os.write(far, bytes.fromhex("c80a0800fc00bd00089764") + bytes([crc8(bytes.fromhex("0800fc00bd00089764"))]))
    heard, deadline = link.listen(), time.monotonic() + 5.0
    while not heard and time.monotonic() < deadline:
        heard = link.listen()
    assert [reading.voltage for reading in heard] == [25.2]
    link.close()


def test_a_port_is_opened_as_its_protocol_needs_and_for_this_program_alone(monkeypatch):
    opened = {}
    monkeypatch.setattr(serial, "Serial", lambda device, baudrate, **others: opened.update(others, baud=baudrate))
    SerialPort("/dev/radio", PROTOCOLS["sbus"])
    assert (opened["baud"], opened["parity"], opened["stopbits"]) == (100_000, "E", 2)
    assert opened["write_timeout"] == 0 and opened["exclusive"]


def test_the_rate_can_be_chosen(wire):
    far, path = wire
    link = make_link(LinkConfig("msp", device=path, baud=230_400, rates=RATES, thrust=THRUST))
    assert termios.tcgetattr(far)[4] == termios.B230400
    link.close()


def test_a_wire_too_slow_for_the_commands_is_refused(wire):
    """MAVLink's two messages, 95 bytes of 10 bits, take 16.5 ms at 57600 baud: 60 a second."""
    pytest.importorskip("pymavlink.dialects.v20.common")
    _, path = wire
    config = LinkConfig("mavlink", device=path, thrust=THRUST)
    assert PROTOCOLS["mavlink"].seconds(96) == pytest.approx(960 / 57_600)
    assert PROTOCOLS["sbus"].seconds(25) == pytest.approx(25 * 12 / 100_000)
    make_link(replace(config, rate=50.0)).close()
    with pytest.raises(
        ValueError, match=r"baud=57600: a command of \d+ bytes takes 1\d\.\d ms.* actor gives 100: .*baud="
    ):
        make_link(replace(config, rate=100.0))
    make_link(replace(config, rate=100.0, baud=115_200)).close()


def fill(path: str) -> None:
    """Write to a wire's near end until it takes no more."""
    descriptor = os.open(path, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        while True:
            os.write(descriptor, b"0")
    except BlockingIOError:
        os.close(descriptor)


@pytest.mark.parametrize("filled", [True, False])
def test_a_full_buffer_waits_for_nobody(wire, filled):
    """There is no room, or too little: commands are dropped and counted, and the next one heard is whole and new."""
    far, path = wire
    link = make_link(LinkConfig("msp", device=path, rates=RATES, thrust=THRUST))
    if filled:
        fill(path)
    start = time.monotonic()
    while not link.dropped and time.monotonic() < start + 5.0:
        link.send(at_rest())
    assert link.dropped == 1 and time.monotonic() < start + 5.0
    sent = link.send(at_rest())
    waiting = b""
    while select.select([far], [], [], 0.2)[0]:
        waiting += os.read(far, 4096)
    assert sent and waiting.endswith(sent)
    link.close()


class Uart:
    """pyserial's port of a UART whose wire takes so many bytes between two writes; pseudo-terminals have no queue."""

    def __init__(self, path: str, drains: int) -> None:
        self.out_waiting, self.drains, self.flushed = 0, drains, 0
        self._descriptor = os.open(path, os.O_WRONLY | os.O_NOCTTY)

    def fileno(self) -> int:
        return self._descriptor

    def tick(self, size: int) -> None:
        self.out_waiting = max(self.out_waiting + size - self.drains, 0)

    def reset_output_buffer(self) -> None:
        self.out_waiting, self.flushed = 0, self.flushed + 1


def test_a_queue_of_old_commands_is_thrown_away_and_said(monkeypatch):
    """The wire takes half of what is written: three commands wait, never more; one that takes all is left alone."""
    for drains, lost in ((38, 0), (19, 5), (0, 27)):
        uart = Uart("/dev/null", drains)
        monkeypatch.setattr("dreamer_racing.hil.links.serial_port.open_port", lambda *of, uart=uart: uart)
        port, taken, queue = SerialPort("/dev/radio", MSP), [], []
        for _ in range(30):
            taken.append(port.write(bytes(38)))
            queue.append(uart.out_waiting + 38)
            uart.tick(38)
        assert taken.count(False) == uart.flushed == lost and max(queue) <= 3 * 38, drains
        assert drains == 0 or all(taken[n] or taken[n + 1] for n in range(29))
        assert drains or not any(taken[3:])  # a wire that takes nothing is said at every command
        os.close(uart.fileno())


def test_what_disarms_waits_behind_nothing(monkeypatch):
    """Two armed commands wait, no backlog; the first disarmed one overtakes them, the others queue up."""
    uart = Uart("/dev/null", 0)
    monkeypatch.setattr("dreamer_racing.hil.links.serial_port.open_port", lambda *of: uart)
    link = make_link(LinkConfig("msp", device="/dev/radio", rates=RATES, thrust=THRUST))
    flushed = []
    for armed in (False, True, True, False, False, True, False):
        link.send(at_rest()._replace(armed=armed))
        flushed.append(uart.flushed)
        uart.out_waiting = 38
    assert flushed == [0, 0, 0, 1, 1, 1, 2] and not link.dropped
    os.close(uart.fileno())


def test_a_device_that_is_pulled_out():
    far, near = os.openpty()
    tty.setraw(near)
    path = os.ttyname(near)
    transport = SerialPort(path, MSP)
    os.close(near)
    os.close(far)
    with pytest.raises(OSError, match=f"device={path}: it is gone: Input/output error"):
        transport.write(b"frame")
    with pytest.raises(OSError, match=f"device={path}: it is gone"):
        next(transport.read())
    transport.close()


@pytest.mark.parametrize(
    ("device", "remedy"),
    [
        ("/dev/no_radio", "there is no such device. Is it plugged in"),
        ("/dev/null", "Could not configure port"),  # no serial port
    ],
)
def test_devices_that_are_none(device, remedy):
    with pytest.raises(OSError, match=f"device={device}: {remedy}"):
        SerialPort(device, MSP)


def test_a_device_of_another_user(monkeypatch):
    """Root may open anything, so pyserial's answer is made up."""

    def refuse(*args, **kw):
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(OSError, match="device=/dev/ttyUSB0: you have no permission to use it: sudo usermod"):
        SerialPort("/dev/ttyUSB0", MSP)


def test_a_device_in_use(wire):
    first = SerialPort(wire[1], MSP)
    with pytest.raises(OSError, match=f"device={wire[1]}: another program uses it"):
        SerialPort(wire[1], MSP)
    first.close()


def test_no_such_rate(wire):
    with pytest.raises(ValueError, match=f"baud={2**40}: "):
        SerialPort(wire[1], SerialSettings(2**40, "N", 1))


def test_without_pyserial(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(ImportError, match=r"pip install .*\[hil\]'"):
        SerialPort("/dev/ttyUSB0", MSP)
