"""The flight loop: at a fixed rate, read the inputs, run the chain, send the command, and record the tick."""

from __future__ import annotations

import gc
import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol, TypeVar

import numpy as np

from dreamer_racing.hil.background_worker import BackgroundWorker
from dreamer_racing.hil.battery import battery_words
from dreamer_racing.hil.chain import FlightChain, Inputs, Outputs, describe_inputs, describe_outputs
from dreamer_racing.hil.operator import Operator, OperatorSource
from dreamer_racing.hil.pose import PoseSource, Received
from dreamer_racing.hil.recording import FlightRecorder
from dreamer_racing.hil.safety import Reason
from dreamer_racing.hil.vehicle import Link, at_rest
from dreamer_racing.hil.watchdog import Watchdog

T = TypeVar("T")
logger = logging.getLogger(__name__)

DISARM_SECONDS = 1.0  # s for which disarm frames are sent after the last tick, however the flight ended
DISARM_RATE = 50.0  # Hz of those frames [choice]
LINES_MOST = 64  # log lines that may wait for a terminal or a pipe [choice]; further ones are dropped
LINES_PATIENCE = 1.0  # s for which the end of a flight waits for these lines [choice]; motors are off by then

OF_THE_ENABLE = (Reason.NO_ENABLE, Reason.NOT_RELEASED)
"""Reasons that change as the operator's enable comes and goes; they are not logged again each time."""

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Signals that end a flight: Ctrl-C, a service's stop, a closed terminal, Ctrl-\\ and Ctrl-Z."""


class Clock(Protocol):
    """A clock to read and to wait on; a plant in lock step has its own."""

    def now(self) -> float:
        """Return the time, s, of a clock that never jumps."""

    def sleep_until(self, deadline: float) -> None:
        """Wait until a time; return at once if it is past."""


class MonotonicClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Return ``time.monotonic``."""
        return time.monotonic()

    def sleep_until(self, deadline: float) -> None:
        """Sleep until a time."""
        remaining = deadline - time.monotonic()
        if remaining > 0.0:
            time.sleep(remaining)


@dataclass
class LoopStatistics:
    """Timings of a flight's ticks, all in s."""

    jitter: list[float] = field(default_factory=list)  # how late each tick began
    pose_age: list[float] = field(default_factory=list)  # age of the newest pose when the command was sent
    # time from a pose's arrival to the sending of the command computed from it
    latency: list[float] = field(default_factory=list)
    render: list[float] = field(default_factory=list)  # rendering time, in ticks that render
    act: list[float] = field(default_factory=list)  # the flyer's computing time
    busy: list[float] = field(default_factory=list)  # time of a tick until its command is sent
    prepare: list[float] = field(default_factory=list)  # time of the work done ahead for the next tick
    overruns: int = 0  # deadlines missed by ticks that took longer than their period: a long one misses several
    unrecorded: bool = False  # whether recording the flight failed on the way

    def summary(self) -> dict[str, Any]:
        """Return p50, p99 and the largest of each in ms, and the counts."""
        stages = ("jitter", "pose_age", "latency", "render", "act", "busy", "prepare")
        table = {name: percentiles(getattr(self, name)) for name in stages}
        return {**table, "ticks": len(self.busy), "overruns": self.overruns, "unrecorded": self.unrecorded}


def percentiles(seconds: list[float]) -> dict[str, float] | None:
    """Return p50, p99 and maximum in ms; None for an empty list."""
    if not seconds:
        return None
    p50, p99, largest = (1e3 * float(value) for value in np.percentile(seconds, (50, 99, 100)))
    return {"p50_ms": p50, "p99_ms": p99, "max_ms": largest}


def summary_lines(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the summary of a flight, as recipes/hil.py writes it, in words."""
    laps = ", ".join(f"{lap:.2f} s" for lap in summary["laps"]) or "none"
    yield f"ended: {summary['ended']}"
    yield f"gates passed: {len(summary['passes'])}, laps, from first gate to first gate: {laps}"
    for name, row in summary["loop"].items():
        if isinstance(row, dict):
            yield f"{name:<9} p50 {row['p50_ms']:6.2f} ms   p99 {row['p99_ms']:6.2f} ms   max {row['max_ms']:6.2f} ms"
    yield f"ticks: {summary['loop']['ticks']}, overruns: {summary['loop']['overruns']}"
    rejected, out_of_order = summary["poses"]["rejected"], summary["poses"]["out_of_order"]
    if rejected or out_of_order:
        yield f"poses ignored: {rejected} invalid messages, {out_of_order} out of order"
    if summary["battery"] is not None:
        yield battery_words(summary["battery"])


class FlightLoop:
    """Flies one flight.

    Args:
        chain: Computes the command of each tick.
        poses: Source of poses.
        operator: Source of the operator's enable and kill.
        link: To the vehicle.
        rate: Hz.
        recorder: None: the flight is not recorded.
        watchers: Called after each tick with its outputs, to display them.
        clock: None: the machine's.

    Attributes:
        flew: Whether the vehicle was armed.
    """

    def __init__(
        self,
        chain: FlightChain,
        poses: PoseSource,
        operator: OperatorSource,
        link: Link,
        rate: float,
        recorder: FlightRecorder | None = None,
        watchers: Sequence[Callable[[Outputs], None]] = (),
        clock: Clock | None = None,
    ) -> None:
        self.statistics = LoopStatistics()
        self.flew = False
        self._chain, self._poses, self._operator, self._link = chain, poses, operator, link
        self._period = 1.0 / rate
        self._recorder, self._watchers = recorder, watchers
        self._clock = clock or MonotonicClock()
        self._watchdog = Watchdog(link, chain.safety.limits.tick_max, self._clock.now)
        self._lines = BackgroundWorker(LINES_MOST)
        self._stop: str | None = None
        self._dropped = False  # whether the command of the tick before was dropped
        self._broken: set[str] = set()  # what has failed: link, source of poses, operator's switch
        self._said: tuple[object, ...] = ()

    def stop(self, reason: str) -> None:
        """End the flight after the present tick."""
        self._stop = self._stop or reason

    def run(self, duration: float | None = None, patience: float | None = None) -> str:
        """Fly until the flight is over; disarm in any case.

        Args:
            duration: s after arming until the flight ends; None: no limit.
            patience: s to wait for arming; None: no limit.

        Returns:
            Why it ended.
        """
        with self._handling_signals(), _without_garbage_collection():
            try:
                self._chain.warm_up()
                return self._run(duration, patience)
            finally:
                self._send_disarm_frames()
                self._watchdog.close()
                self._lines.close(LINES_PATIENCE)

    def _run(self, duration: float | None, patience: float | None) -> str:
        began = deadline = self._clock.now()
        overrun, flew, armed, words = 0, False, False, ""
        while self._stop is None:
            self._clock.sleep_until(deadline)
            start = self._clock.now()
            outputs = self._tick(start, deadline, overrun, armed)
            words = self._log_reasons(outputs, flew)
            armed = outputs.verdict.command.armed
            if armed and not flew:
                flew, began = True, start
                self.flew = True
                self._log(logging.INFO, "armed")
            deadline, overrun = self._next(deadline)
            if self._watchdog.acted:
                longest = self._chain.safety.limits.tick_max
                met = self._watchdog.error
                did = "disarmed the vehicle" if met is None else f"could not disarm the vehicle: {met}"
                return f"cut: no command for more than {longest:g} s: the watchdog {did}"
            if flew and not armed:
                return f"{outputs.verdict.state.value}: {words or 'disarmed'}"
            most = duration if flew else patience
            if most is not None and start - began >= most:
                return f"{most:g} s are over" + ("" if flew else f"; not armed: {words}")
        return self._stop + ("" if flew else f"; not armed: {words}")

    def _log_reasons(self, outputs: Outputs, flew: bool) -> str:
        """Log why the vehicle is not armed, or why the flight ended, when it changes; return it. In flight log nothing.

        An enable that comes and goes is no change as long as another reason prevents arming.
        """
        verdict = outputs.verdict
        rejected = self._poses.rejected if Reason.POSE_LOST in verdict.reasons else 0
        words = "; ".join(verdict.words) + (f"; {rejected} messages were not poses" if rejected else "")
        reasons = tuple(reason for reason in verdict.reasons if reason not in OF_THE_ENABLE) or verdict.reasons
        said = *reasons, rejected > 0
        if not verdict.command.armed and said != self._said:
            self._log(logging.INFO, "%s: %s", verdict.state.value if flew else "not armed", words)
        self._said = said
        return words

    def _log(self, level: int, message: str, *values: object, error: Exception | None = None) -> None:
        """Log a line without waiting for the terminal."""
        self._lines.submit(lambda: logger.log(level, message, *values, exc_info=error))

    def _tick(self, start: float, deadline: float, overrun: int, armed: bool) -> Outputs:
        """Run one tick: inputs → chain → link → recording."""
        # What fails gives no enable, a dropped command or no poses, so that safety cuts, or holds and then cuts.
        operator = self._use("the operator's switch", lambda: self._operator.poll(armed), Operator(False, False))
        heard = self._use("the link", self._link.listen, None)
        samples = self._link.read_imu()  # read in any case, or they would pile up
        imu = samples if self._chain.needs_imu else []
        refusal = self._link.refusal
        poses: list[Received] = self._use("the source of poses", self._poses.poll, [])
        inputs = Inputs(start, poses, operator, overrun, heard or [], self._dropped, imu, refusal)
        outputs = self._chain.tick(inputs)
        if outputs.voltage is not None:
            self._link.set_voltage(outputs.voltage)
        sent = self._use("the link", lambda: self._watchdog.send(outputs.verdict.command), b"")
        self._dropped = not sent or heard is None
        done = self._clock.now()
        self._record_timings(start - deadline, inputs, outputs, done)
        took = {"jitter": start - deadline, "render": outputs.render_s, "act": outputs.act_s, "sent": done - start}
        self._show(inputs, outputs, took, sent)
        shown = self._clock.now()
        self._chain.prepare()
        self.statistics.prepare.append(self._clock.now() - shown)
        return outputs

    def _use(self, part: str, use: Callable[[], T], instead: T) -> T:
        """Return what a part gives; if it fails, as an unplugged adapter does, log its first error, and return this."""
        try:
            return use()
        except OSError as error:
            if part not in self._broken:
                self._log(logging.ERROR, "%s fails: %s", part, error)
            self._broken.add(part)
            return instead

    def _show(self, inputs: Inputs, outputs: Outputs, took: dict[str, float], sent: bytes) -> None:
        """Record and show a tick; a full disk, or a page that fails, must not end a flight."""
        try:
            if self._recorder is not None:
                message = {"in": describe_inputs(inputs), "out": describe_outputs(outputs), "took": took, "bytes": sent}
                self._recorder.tick(inputs.time, message)
        except Exception as error:
            self._log(logging.ERROR, "recording failed: the flight continues, but is no longer recorded", error=error)
            self.statistics.unrecorded = True
            self._recorder = None
        try:
            for watch in self._watchers:
                watch(outputs)
        except Exception as error:
            self._log(logging.ERROR, "the view failed: the flight continues, but is no longer shown", error=error)
            self._watchers = ()

    def _next(self, deadline: float) -> tuple[float, int]:
        """Return the next deadline, on the same grid however late the loop is, and how many were missed."""
        now, following = self._clock.now(), deadline + self._period
        if now < following:
            return following, 0
        left_out = int((now - following) // self._period)  # skipped deadlines; the next one is late
        self.statistics.overruns += left_out + 1
        return following + self._period * left_out, left_out + 1

    def _record_timings(self, jitter: float, inputs: Inputs, outputs: Outputs, done: float) -> None:
        noted = self.statistics
        noted.jitter.append(jitter)
        noted.busy.append(done - inputs.time)
        if outputs.setpoint is not None:
            noted.render += [outputs.render_s] if outputs.render_s else []
            noted.act.append(outputs.act_s)
        if outputs.pose is not None:
            noted.pose_age.append(done - outputs.measured)
        if inputs.received:
            noted.latency.append(done - inputs.received[-1].time)

    def _send_disarm_frames(self) -> None:
        """Send disarm frames for a while: the vehicle must hear one, and radios lose some."""
        deadline, failed = self._clock.now(), False
        for _ in range(round(DISARM_SECONDS * DISARM_RATE)):
            try:
                self._watchdog.send(at_rest())
            except Exception as error:  # whatever failed, the next frame may get through
                if not failed:
                    self._log(logging.ERROR, "the link did not send the disarm frame: %s", error)
                failed = True
            deadline += 1.0 / DISARM_RATE
            self._clock.sleep_until(deadline)

    @contextmanager
    def _handling_signals(self) -> Iterator[None]:
        """Let the signals of `ENDING` end the flight; a second one does not interrupt the final disarm frames."""

        def stop(number: int, frame: FrameType | None) -> None:
            self.stop(f"{signal.Signals(number).name}")

        before = {number: signal.signal(number, stop) for number in ENDING}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Disable the garbage collector, which would stall the loop; reference counting frees a flight's objects."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
