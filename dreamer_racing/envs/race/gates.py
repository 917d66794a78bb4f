"""Detection of gate passes and crashes of N drones.

Shape legend: N drones, P physics steps per control step, G race gates. SI units, world z up.

The path of one control step is a chain of P straight segments. Each event on it has an exact time, counted in segments
(1.5 is the middle of the second segment):

* a race gate's plane is crossed inside the frame's outer square: through the margin-reduced opening in the direction
  of flight (a pass if it is the target gate, else no event), through it backwards (crash), or outside it (crash);
* a frame is touched from any side: it is a box of the frame's depth, around the margin-reduced opening (crash);
* if misses end episodes: the target gate's plane is crossed in the direction of flight outside its frame (crash);
* the free box is left: the ground at 0.05 m, or the track's bounding box (crash);
* the position is not finite (crash).

Crossing rule. A drone is *ahead* of a plane when its signed distance along the direction of flight is >= 0, and a
crossing is a change of *ahead* from one sample to the next: ``d0 < 0 <= d1`` forward, ``d0 >= 0 > d1`` backwards.
Every sample is on exactly one side, so no crossing is lost or counted twice when a sample lies on the plane, and the
result does not depend on where a path is split into segments or control steps.

The first crash ends the path: later events do not count. A pass before the first crash of the same control step
counts, and both are reported. At equal times, the crash wins. Decoy gates are ignored.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

import torch

from dreamer_racing.envs.tracks import GROUND_HEIGHT, Track


class CrashCause(enum.IntEnum):
    """Why an episode ended in a crash; NONE while flying."""

    NONE = 0
    GATE_FRAME = 1
    GATE_BACKWARDS = 2
    GROUND = 3
    OUT_OF_BOUNDS = 4
    NON_FINITE_STATE = 5
    INVALID_ACTION = 6
    GATE_MISSED = 7


_PARALLEL = 1e-30  # m: replaces a displacement of zero in divisions


class GateSweep(NamedTuple):
    """Gate passes and first crash of each drone in one control step."""

    passes: torch.Tensor  # (N,) int64: gates passed before any crash: 1 for the target, 2 for it and the next gate
    offset: torch.Tensor  # (N,) m, from the target's centre to the point of the pass, in its plane; 0 if not passed
    crash: torch.Tensor  # (N,) int64: the `CrashCause` of the first crash, 0 where there was none


class _Crossings(NamedTuple):
    """Crossings of every race gate's plane by every segment, all (G, P, N); the others are valid where ``crossed``."""

    crossed: torch.Tensor  # bool
    forward: torch.Tensor  # bool: in the direction of flight
    time: torch.Tensor  # segment index plus fraction
    left: torch.Tensor  # m from the gate's centre
    up: torch.Tensor  # m from the gate's centre


class GateSweeper:
    """Finds the pass and the first crash of N drones on one track.

    At most two passes are reported per control step, and at most one if no gate lies within reach of the gate before
    it: at 18 m/s a drone flies 0.36 m in a step of 20 ms. Tensors are laid out (gate, step, drone), so that the long
    axis is contiguous. No matrix product is used, whose reduced-precision modes would degrade positions on a GPU.

    Args:
        track: the track; only its race gates, shape and bounding box matter.
        miss_radius: crossing the target gate's plane outside its frame and less than this from its centre is a crash,
            m; 0 allows it.
        reach: the farthest that a drone flies in a control step, m.

    Raises:
        ValueError: the miss radius is within the frame.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> sweeper = GateSweeper(load_track("circle"))
        >>> path = torch.tensor([[4.0, -0.1, 1.35], [4.0, 0.1, 1.35]]).unsqueeze(1)  # (P + 1, N, 3)
        >>> sweeper(path, torch.tensor([0])).passes
        tensor([1])
    """

    def __init__(
        self,
        track: Track,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        miss_radius: float = 0.0,
        reach: float = math.inf,
    ):
        x, y, z = track.gate_positions(device, torch.float64).unbind(1)
        yaw = track.gate_yaws(device, torch.float64)
        cos, sin = yaw.cos(), yaw.sin()

        def column(values: torch.Tensor) -> torch.Tensor:
            return values.to(dtype).view(-1, 1, 1)

        self._cos, self._sin = column(cos), column(sin)
        # Each gate's centre in its own axes, subtracted from positions rotated into the same axes.
        self._centre_forward, self._centre_left, self._centre_up = (
            column(x * cos + y * sin),
            column(y * cos - x * sin),
            column(z),
        )
        self._half_opening = track.shape.pass_half_width
        self._half_outer = track.shape.outer / 2
        self._half_depth = track.shape.depth / 2
        if miss_radius and not miss_radius > self._half_outer:
            raise ValueError(
                f"miss_radius={miss_radius}: must be more than {self._half_outer:g} m, which is half the width of the "
                "frame, or 0: then drones fly on after a miss."
            )
        self._miss_radius = miss_radius
        self._gates = torch.arange(len(x), device=device).view(-1, 1, 1)
        self._two_in_reach = any(
            math.dist(gate.position, after.position) < reach + 2 * math.hypot(self._half_opening, self._half_opening)
            for gate, after in zip(track.gates, (*track.gates[1:], track.gates[0]), strict=True)
        )

        self._picks = torch.device(device).type == "cpu"  # on CUDA, selecting drones would synchronise
        self._frame_low, self._frame_high = (
            corner.to(dtype).unsqueeze(-1) for corner in _frame_boxes(track, torch.stack((x, y, z)), yaw)
        )

        low_x, low_y, low_z = track.bounds_low
        floor = max(low_z, GROUND_HEIGHT)
        self._low = torch.tensor([low_x, low_y, floor], device=device, dtype=dtype).view(3, 1, 1)
        self._high = torch.tensor(track.bounds_high, device=device, dtype=dtype).view(3, 1, 1)
        floor_cause = CrashCause.GROUND if low_z <= GROUND_HEIGHT else CrashCause.OUT_OF_BOUNDS
        wall = CrashCause.OUT_OF_BOUNDS
        # one cause for each row of the crash times in `__call__`
        self._causes = torch.tensor(
            [
                CrashCause.GATE_FRAME,
                CrashCause.GATE_BACKWARDS,
                CrashCause.NON_FINITE_STATE,
                *(wall, wall, floor_cause),
                *(wall, wall, wall),
                CrashCause.GATE_MISSED,
            ],
            device=device,
        )

    def __call__(self, path: torch.Tensor, target_gate: torch.Tensor) -> GateSweep:
        """Find the passes and the first crash in one control step.

        Args:
            path: positions at the start and after each physics step, (P + 1, N, 3), m.
            target_gate: index of the next gate of each drone, (N,) int64.
        """
        num_drones = target_gate.shape[0]
        assert path.shape[1:] == (num_drones, 3), f"path must be (P + 1, {num_drones}, 3), got {tuple(path.shape)}"
        assert path.shape[0] >= 2, f"path needs at least 2 positions, got {path.shape[0]}"
        # (P + 1, N, 3) -> (3, P + 1, N)
        position = path.permute(2, 0, 1).contiguous()
        finite = position.isfinite().all(0)  # (P + 1, N)
        # NaN in place of infinity, because no comparison with NaN is true
        position = torch.where(finite, position, math.nan)
        segment = torch.arange(path.shape[0] - 1, device=path.device, dtype=path.dtype).view(-1, 1)  # (P, 1)

        crossings = self._cross_gates(position, segment)
        offset = torch.maximum(crossings.left.abs(), crossings.up.abs())  # (G, P, N)
        through = crossings.crossed & (offset < self._half_opening)
        into_frame = crossings.crossed & (offset < self._half_outer) & ~through
        pass_time, pass_offset = self._first_pass(crossings, through, target_gate)
        frame = torch.minimum(_first(into_frame, crossings.time), self._touch_frames(position, segment))
        backwards = _first(through & ~crossings.forward, crossings.time)
        non_finite = _first(~(finite[:-1] & finite[1:]), segment)
        # rows in the order of `_causes`
        crash_times = [torch.stack((frame, backwards, non_finite)), self._leave_box(position, segment)]
        if self._miss_radius:
            near = torch.hypot(crossings.left, crossings.up) < self._miss_radius
            beside = crossings.crossed & crossings.forward & (offset >= self._half_outer) & near
            missed = beside & (self._gates == target_gate) & (crossings.time < pass_time)
            crash_times.append(_first(missed, crossings.time).unsqueeze(0))
        crash_time, row = torch.cat(crash_times).min(0)  # at equal times the first row wins
        crash = torch.where(crash_time.isfinite(), self._causes[row], int(CrashCause.NONE))
        passed = pass_time < crash_time
        passes = passed.long()
        if self._two_in_reach:
            next_gate = (target_gate + 1).remainder(len(self._gates))
            next_time, _ = self._first_pass(crossings, through, next_gate, after=pass_time)
            passes += next_time < crash_time
        return GateSweep(passes, torch.where(passed, pass_offset, 0.0), crash)

    def _cross_gates(self, position: torch.Tensor, segment: torch.Tensor) -> _Crossings:
        """Intersect every segment with every race gate's plane; position is (3, P + 1, N)."""
        forward, left, up = self._to_gate_axes(position)
        ahead = forward >= 0
        before, after = forward[:, :-1], forward[:, 1:]
        fraction = before / (before - after)
        return _Crossings(
            crossed=ahead[:, :-1] ^ ahead[:, 1:],
            forward=ahead[:, 1:],
            time=segment + fraction,
            left=torch.addcmul(left[:, :-1], fraction, left.diff(dim=1)),
            up=torch.addcmul(up[:, :-1], fraction, up.diff(dim=1)),
        )

    def _to_gate_axes(self, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return positions (3, P + 1, N) relative to every race gate: forward, left and up, (G, P + 1, N) each."""
        x, y, z = position.unbind(0)
        forward = x * self._cos + y * self._sin - self._centre_forward
        left = y * self._cos - x * self._sin - self._centre_left
        return forward, left, z - self._centre_up

    def _first_pass(
        self, crossings: _Crossings, through: torch.Tensor, target_gate: torch.Tensor, after: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the time of the first target gate pass later than ``after`` (inf: none) and its offset, (N,)."""
        num_steps = through.shape[1]
        target = target_gate.view(1, 1, -1).expand(1, num_steps, -1)
        passing = (through & crossings.forward).gather(0, target).squeeze(0)  # (P, N)
        crossing_time = crossings.time.gather(0, target).squeeze(0)
        if after is not None:
            passing &= crossing_time > after
        time = torch.where(passing, crossing_time, math.inf)
        first_time, step = time.min(0)
        # (G, P, N) -> (G * P, N), so that one index picks the gate and the segment
        index = (target_gate * num_steps + step).unsqueeze(0)
        left = crossings.left.flatten(0, 1).gather(0, index).squeeze(0)
        up = crossings.up.flatten(0, 1).gather(0, index).squeeze(0)
        return first_time, torch.hypot(left, up)

    def _touch_frames(self, position: torch.Tensor, segment: torch.Tensor) -> torch.Tensor:
        """Return the time of the first frame contact, (N,), inf if none; position is (3, P + 1, N)."""
        # (3, 1, N) against (3, G, 1): most drones are not near a frame
        low, high = position.amin(1, keepdim=True), position.amax(1, keepdim=True)
        # (N,); true also for non-finite paths, which may have touched a frame before
        near = ~((high < self._frame_low) | (low > self._frame_high)).any(0).all(0)
        time = torch.full_like(position[0, 0], math.inf)
        if not self._picks:
            return self._enter_bars(position, segment).where(near, time)
        drones = near.nonzero().squeeze(-1)
        if len(drones):
            time[drones] = self._enter_bars(position[:, :, drones], segment)
        return time

    def _enter_bars(self, position: torch.Tensor, segment: torch.Tensor) -> torch.Tensor:
        """Return the same as `_touch_frames` for drones that may be near a frame.

        Within the outer box, a segment is farthest from the gate's axis at one of its ends, so only the ends need to
        be tested against the opening.
        """
        forward, left, up = self._to_gate_axes(position)
        sides = _within(forward, self._half_depth), _within(left, self._half_outer), _within(up, self._half_outer)
        enter = torch.stack([side[0] for side in sides]).amax(0).clamp(min=0)  # (G, P, N)
        leave = torch.stack([side[1] for side in sides]).amin(0).clamp(max=1)
        starts_outside, ends_outside = (
            torch.maximum(_interpolate(left, fraction).abs(), _interpolate(up, fraction).abs()) >= self._half_opening
            for fraction in (enter, leave)
        )
        out_of_opening = torch.minimum(_within(left, self._half_opening)[1], _within(up, self._half_opening)[1])
        touched = (enter <= leave) & (starts_outside | ends_outside)
        return _first(touched, segment + torch.where(starts_outside, enter, out_of_opening.clamp(0, 1)))

    def _leave_box(self, position: torch.Tensor, segment: torch.Tensor) -> torch.Tensor:
        """Return the time at which each side of the free box is left, (6, N): low x, y, z, high x, y, z; inf if never.

        A sample outside counts even without a crossing (an episode that began there), from the segment's start.
        """
        clearance = torch.cat((position - self._low, self._high - position))  # (6, P + 1, N), negative outside
        before, after = clearance[:, :-1].clamp(min=0), clearance[:, 1:]
        # `before` is NaN, hence not >= 0, after a non-finite position: that crash is found elsewhere.
        leaving = (after < 0) & (before >= 0)
        time = torch.where(leaving, segment + before / (before - after), math.inf)
        return time.amin(1)


def _first(event: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Return the earliest time of an event for each drone, inf if it does not happen: (..., N) -> (N,)."""
    return torch.where(event, time, math.inf).flatten(0, -2).amin(0)


def _frame_boxes(track: Track, centre: torch.Tensor, yaw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the lower and upper corners (3, G) of each frame's axis-aligned bounding box."""
    wide, deep = track.shape.outer / 2, track.shape.depth / 2
    sin, cos = yaw.sin().abs(), yaw.cos().abs()
    half = torch.stack((wide * sin + deep * cos, wide * cos + deep * sin, torch.full_like(yaw, wide)))
    return centre - half, centre + half


def _within(axis: torch.Tensor, half: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the fractions (G, P, N) of each segment at which it enters and leaves the interval [-half, half].

    Reference: Kay and Kajiya 1986, "Ray tracing complex scenes" (slabs).
    """
    before, delta = axis[:, :-1], axis.diff(dim=1)
    delta = torch.where(delta == 0, _PARALLEL, delta)
    one, other = (-half - before) / delta, (half - before) / delta
    return torch.minimum(one, other), torch.maximum(one, other)


def _interpolate(axis: torch.Tensor, fraction: torch.Tensor) -> torch.Tensor:
    """Interpolate coordinates (G, P + 1, N) along each segment at a fraction (G, P, N)."""
    return torch.addcmul(axis[:, :-1], fraction, axis.diff(dim=1))
