"""`RaceWorlds`: simulator, race rules and start poses combined, for N drones on N copies of a track.

The TorchRL and Gymnasium environments are thin adapters of this class. Shapes: N worlds, A action (4). SI units.
"""

import inspect
import os
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import (
    QuadrotorParameters,
    at_control_rate,
    load_preset,
    without_randomisation,
)
from dreamer_racing.envs.held_frames import FrameHold
from dreamer_racing.envs.imu import Imu, ImuErrors, load_imu
from dreamer_racing.envs.own import CustomFunction, RaceState, RewardFunction, Transition, VectorFunction
from dreamer_racing.envs.race.race import (
    EPISODE_TIME,
    EVALUATION_TIME,
    RACE_VECTOR_SIZE,
    Race,
    RaceStep,
    RaceVector,
    RewardWeights,
)
from dreamer_racing.envs.race.racing_line import START_LINE, plan_racing_line
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.simulator.looks import LooksRandomisation, load_looks
from dreamer_racing.envs.simulator.scene import Camera, frame_interval, load_camera
from dreamer_racing.envs.simulator.simulators import Simulator, check_device, make_simulator
from dreamer_racing.envs.simulator.warp_device import GraphedFunction
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.machine import is_out_of_memory
from dreamer_racing.settings import (
    NOT_NEGATIVE,
    SHARE,
    check_flags,
    check_numbers,
    check_setting,
    quoted,
    suggestion,
    without_none,
)

ACTION_SIZE = 4


class RaceOptions(TypedDict, total=False):
    """Arguments that every environment passes on to `RaceWorlds`, where they are documented."""

    evaluation: bool
    episode_steps: int | None
    weights: RewardWeights | None
    renderer: str
    camera: Camera | None
    looks: str | LooksRandomisation | None
    num_threads: int | None
    backend: str
    start_beyond_gate: float
    start_at_gate: float
    start_on_line: float
    start_noise: float
    miss_radius: float
    action_change_weight: float
    control_rate: float | None
    camera_rate: float | None
    imu: str | ImuErrors | None
    reward: str | RewardFunction | None
    vector: str | VectorFunction | None


class WorldOptions(RaceOptions, total=False):
    """`RaceOptions` plus `device` and `seed`, for environments that do not have these arguments themselves."""

    device: torch.device | str
    seed: int | None


def check_options(environment: type, given: Mapping[str, object], options: type) -> None:
    """Refuse arguments that neither an environment nor `RaceWorlds` takes.

    The message has Python's wording, by which TorchRL's `GymEnv` detects that an environment takes no frameskip.

    Args:
        environment: the class whose `__init__` was called.
        given: the keyword arguments that it does not name itself.
        options: `RaceOptions` or `WorldOptions`.

    Raises:
        TypeError: the message names the environment, the argument and the closest known argument.
    """
    own = [
        name for name in inspect.signature(vars(environment)["__init__"]).parameters if name not in ("self", "worlds")
    ]
    known = [*own, *options.__annotations__]
    for name in given:
        if name not in known:
            images = "; observation= chooses whether images are rendered" if name == "from_pixels" else ""
            raise TypeError(
                f"{environment.__name__} got an unexpected keyword argument {name!r}{suggestion(name, known)}{images}. "
                f"It takes {', '.join(known)}."
            )


def check_action(action: Tensor | np.ndarray, num_envs: int | None = None) -> None:
    """Refuse actions that are not floating-point numbers (N, 4), or (4,) without a number of environments.

    Raises:
        TypeError: wrong type.
        ValueError: wrong shape.
    """
    is_float = action.is_floating_point() if isinstance(action, Tensor) else action.dtype.kind == "f"
    if not is_float:
        raise TypeError(f"Action of {action.dtype}: thrust and body rates are floating-point numbers in [-1, 1].")
    shape = (ACTION_SIZE,) if num_envs is None else (num_envs, ACTION_SIZE)
    if tuple(action.shape) != shape:
        where = "" if num_envs is None else f", for {num_envs} environment(s)"
        raise ValueError(
            f"Action of shape {tuple(action.shape)}: must be {shape}{where}: collective thrust and body rates x, y, z, "
            "each in [-1, 1]."
        )


class RaceWorlds:
    """N independent copies of the race, with one drone each.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        num_envs: N.
        preset: physics preset (`easy`, `faithful`, `betaflight`) or parameters.
        evaluation: start at the start pose, at rest, and finish after the track's laps.
        episode_steps: control steps until an episode is truncated; None for 20 s, in evaluation 30 s.
        weights: reward weights of Eq. 1 of the paper.
        from_pixels: whether images are rendered.
        renderer: `auto`, or on CPU a name from `rendering.RENDERERS`, or `warp_cuda` to render on a CUDA device.
        camera: the nose camera.
        looks: `nominal`; `randomised` for new light, colours, camera tilt, lens and noise in every episode; or the
            ranges of the randomisation.
        num_threads: threads of physics and rendering on CPU; None for one per CPU, at most `OMP_NUM_THREADS`.
        device: `cpu` or a CUDA device. On CUDA a step is one CUDA graph without synchronisation.
        backend: `auto` (`mujoco` on CPU, `mujoco_warp` on CUDA), `mujoco`, or `mujoco_warp` (on CPU for tests: slow).
        seed: seed of start poses and of the randomisation of physics and looks.
        start_beyond_gate: share of the training episodes not on the racing line that begin behind a gate; see
            `StartSampler`.
        start_at_gate: share of the remaining training episodes that begin before a gate instead of at the start.
        start_on_line: share of training episodes that begin on a planned racing line, which takes some seconds to plan.
        start_noise: noise of evaluation starts, as a multiple of that of training starts.
        miss_radius: a training episode ends with a crash if the target gate's plane is crossed outside its frame and
            less than this distance from its centre, m; 0 to fly on. Only for tracks on which the path to a gate does
            not lead past it.
        action_change_weight: b₃, penalty in training per unit of ‖aₜ − aₜ₋₁‖², except in the first step of an episode
            and in a step that ends in a crash; 0 as in the paper. Champion-level drone racing (Kaufmann et al., Nature
            620, 2023, Extended Data Table 1a: λ₅, with λ₁ = 1 per metre of progress, as here) has 1e-4.
        control_rate: actions per second, Hz; None for the preset's, 50.
        camera_rate: frames per second, Hz: `control_rate` divided by a whole number. The image is repeated, not
            rendered again, until the next frame; None for the camera's rate, by default a frame per control step.
        imu: gyro and accelerometer beside the images: `exact`, `noisy` (see `IMUS`), or an error model; None for none.
        reward: function of a `Transition` that returns the rewards (N,), in place of Eq. 1 without its body-rate
            penalty; or `module:function`; None for Eq. 1. See `docs/own_rewards.md`.
        vector: function of a `RaceState` that returns the observation `vector` (N, V), with or without images; or
            `module:function`; None for the race vector if there are no images.

    Raises:
        ValueError: invalid argument; the message says which and what is allowed.
        TrackError: unknown or invalid track.

    Example:
        >>> worlds = RaceWorlds("circle", num_envs=2, from_pixels=False)
        >>> worlds.reset()
        >>> worlds.step(torch.zeros(2, 4)).terminated.shape
        torch.Size([2])
    """

    _images: Tensor | None = None  # (N, H, W, 3) current images, if the last step rendered them

    def __init__(
        self,
        track: str | Track,
        num_envs: int = 1,
        preset: str | QuadrotorParameters = "easy",
        *,
        evaluation: bool = False,
        episode_steps: int | None = None,
        weights: RewardWeights | None = None,
        from_pixels: bool = True,
        renderer: str = "auto",
        camera: Camera | None = None,
        looks: str | LooksRandomisation | None = None,
        num_threads: int | None = None,
        device: torch.device | str = "cpu",
        backend: str = "auto",
        seed: int | None = None,
        start_beyond_gate: float = 0.0,
        start_at_gate: float = 0.5,
        start_on_line: float = 0.0,
        start_noise: float = 0.0,
        miss_radius: float = 0.0,
        action_change_weight: float = 0.0,
        control_rate: float | None = None,
        camera_rate: float | None = None,
        imu: str | ImuErrors | None = None,
        reward: str | RewardFunction | None = None,
        vector: str | VectorFunction | None = None,
    ) -> None:
        _check_counts(num_envs, episode_steps=episode_steps, num_threads=num_threads)
        check_flags(evaluation=evaluation, from_pixels=from_pixels)
        check_device(device)
        varied = load_looks(looks, from_pixels)
        self.camera, errors = load_camera(camera, camera_rate, from_pixels), load_imu(imu, from_pixels)
        self._process, self._from_pixels = os.getpid(), from_pixels
        self.track, self.evaluation, self.num_envs = load_track(track), evaluation, int(num_envs)
        self.parameters = at_control_rate(load_preset(preset), control_rate)
        interval = frame_interval(self.camera, 1.0 / self.parameters.control_dt)
        self._generator = torch.Generator(device)
        self.seed(seed)
        self.simulator: Simulator = make_simulator(
            self.track,
            self.parameters,
            self.num_envs,
            self.camera,
            renderer if from_pixels else None,
            num_threads,
            self._generator,
            device,
            backend,
            varied,
        )
        self.device, self.dtype = self.simulator.device, self.simulator.dtype
        self.race = self._make_race(weights, episode_steps, miss_radius)
        self._make_numbers(errors, vector)
        self._make_rewards(action_change_weight, reward)
        self._starts = self._make_starts(start_beyond_gate, start_at_gate, start_noise, start_on_line)
        self._held = FrameHold(interval, self._draw) if from_pixels and interval > 1 else None
        self._graphs: dict[bool, GraphedFunction] = {}  # CUDA graphs of a control step, by whether it renders
        self.has_reset = False

    def _make_race(self, weights: RewardWeights | None, episode_steps: int | None, miss_radius: float) -> Race:
        check_setting("miss_radius", miss_radius, NOT_NEGATIVE)
        if episode_steps is None:
            episode_steps = round((EVALUATION_TIME if self.evaluation else EPISODE_TIME) / self.parameters.control_dt)
        return Race(
            self.track,
            self.num_envs,
            weights=weights,
            episode_steps=episode_steps,
            laps=self.track.laps if self.evaluation else None,
            control_dt=self.parameters.control_dt,
            device=self.device,  # in float32: micrometre precision suffices for gates, in half the time
            miss_radius=0.0 if self.evaluation else miss_radius,
        )

    def _make_numbers(self, errors: ImuErrors | None, vector: str | VectorFunction | None) -> None:
        """Make the sources of vector observations: the IMU, and the race vector or a user-defined function."""
        if vector is not None and errors is not None:
            raise ValueError("imu= and vector= cannot be combined: leave one of them out.")
        self.imu = None if errors is None else Imu(errors, self.simulator.ideal_imu, self._generator)
        self.race_vector = RaceVector(self.track, self.device, self.dtype)
        self._last_action = torch.zeros(self.num_envs, ACTION_SIZE, device=self.device)
        self.custom_vector, self.vector_size = None, RACE_VECTOR_SIZE
        if vector is not None:
            self.custom_vector = CustomFunction("vector", vector, self.num_envs, self.device)
            self.vector_size = self.observed_vector().shape[1]

    def _make_rewards(self, action_change_weight: float, reward: str | RewardFunction | None) -> None:
        """Set b₃, which applies only in training, and the user-defined reward function, if any."""
        check_setting("action_change_weight", action_change_weight, NOT_NEGATIVE)
        self.action_change_weight = 0.0 if self.evaluation else float(action_change_weight)
        self.custom_reward = None if reward is None else CustomFunction("reward", reward, self.num_envs, self.device)
        self._tracks_last_action = bool(self.action_change_weight or self.custom_reward or self.custom_vector)

    def _make_starts(self, beyond_gate: float, at_gate: float, noise: float, on_line: float) -> StartSampler:
        """Make the sampler of start poses, and plan the racing line if episodes begin on it."""
        check_setting("start_on_line", on_line, SHARE)
        on_line = 0.0 if self.evaluation else on_line
        line = plan_racing_line(self.track, without_randomisation(self.parameters), START_LINE) if on_line else None
        return StartSampler(
            self.track, self._generator, self.device, self.dtype, beyond_gate, noise, on_line, line, at_gate
        )

    @property
    def start_on_line(self) -> float:
        """Share of training episodes that begin on the racing line; settable only if it was positive initially."""
        return self._starts.on_line

    @start_on_line.setter
    def start_on_line(self, share: float) -> None:
        self._starts.on_line = share

    def seed(self, seed: int | None) -> None:
        """Seed start poses and physics randomisation; None draws a seed from the operating system.

        Raises:
            ValueError: the seed is no integer, or out of a generator's range.
        """
        check_numbers(without_none(seed=seed), {})
        if seed is not None and not 0 <= seed < 2**63:
            raise ValueError(f"seed={quoted(seed)}: must be at least 0 and below 2**63.")
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(int(seed))

    def _check_process(self) -> None:
        """Refuse to run in a forked child, which lacks the worker threads and would wait for them for ever."""
        if os.getpid() != self._process:
            raise RuntimeError(
                f"These worlds were made in process {self._process}. Process {os.getpid()} was forked from it and "
                "lacks its worker threads: make the worlds in the process that uses them, or start that process by "
                "multiprocessing's 'spawn'."
            )

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes in the masked worlds (N,) bool; in all if None.

        Raises:
            RuntimeError: this process was forked from the one that made the worlds.
        """
        self._check_process()
        for own in filter(None, (self.custom_reward, self.custom_vector)):
            own.check()
        whole = mask is None
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        start = self._starts.sample(self.num_envs, self.evaluation)
        self.simulator.reset(mask, start.position, start.attitude, start.linear_velocity)
        self.race.begin(mask, start.position, start.target_gate)
        self._images, self.has_reset = None, True
        if self._tracks_last_action:
            self._last_action.masked_fill_(mask.unsqueeze(-1), 0.0)
        if self._held is not None:
            together = whole or (self.device.type == "cpu" and bool(mask.all()))  # on CUDA it would synchronise
            self._held.begin(None if together else mask)
        if self.imu is not None:
            self.imu.begin(mask)

    def step(self, action: Tensor) -> RaceStep:
        """Simulate one control step. The simulator is not differentiable: no gradient flows to the action.

        Args:
            action: (N, 4), on the worlds' device; values beyond [-1, 1] are clipped. A non-finite action is a crash of
                its drone only.

        Raises:
            RuntimeError: no episode has begun, or this process was forked from the one that made the worlds.
            TypeError: the action is not of a floating-point type.
            ValueError: wrong shape or device.
        """
        self._check_process()
        if not self.has_reset:
            raise RuntimeError("Step before the first reset: call reset() to begin episodes.")
        check_action(action, self.num_envs)
        action = action.detach()  # delayed commands would otherwise keep all previous autograd graphs
        if action.device != self.device:
            raise ValueError(f"Action on {action.device}: must be on {self.device}, like these worlds.")
        outcome = self._fly(action) if self.device.type != "cuda" else self._replay(action)
        if self._held is not None:
            self._held.step()
        if self.imu is not None:
            self.imu.step()
        return outcome

    def _replay(self, action: Tensor) -> RaceStep:
        """Replay one control step as a CUDA graph, including the rendering if a frame is due."""
        draws = self._from_pixels and (self._held is None or self._held.next_is_frame)
        if draws not in self._graphs:
            self._graphs[draws] = self._capture(action, draws)
        outcome = list(self._graphs[draws](action))
        self._images = outcome.pop() if draws else None
        return RaceStep(*outcome)

    def _fly(self, action: Tensor) -> RaceStep:
        """Simulate one control step and apply the race rules, without synchronising with a CUDA device."""
        invalid = ~action.isfinite().all(dim=1)
        flown = action.nan_to_num(0.0, 0.0, 0.0)
        before = None if self.custom_reward is None else self.race_state()
        path = self.simulator.step(flown)
        outcome = self.race.step(path, self.simulator.state.body_rates, invalid)
        if not self._tracks_last_action:
            return outcome
        first = self.race.step_count == 1  # no previous action
        reward, flown = outcome.reward_base, flown.float().clamp(-1.0, 1.0)
        change = (flown - self._last_action).square().sum(1).masked_fill(first | outcome.terminated, 0.0)
        self._last_action.copy_(flown)
        if self.custom_reward is not None and before is not None:
            reward = self.custom_reward.rewards(Transition(before, self.race_state(), outcome))
        if self.action_change_weight:
            reward = reward - self.action_change_weight * change
        return replace(outcome, reward_base=reward)

    def _capture(self, action: Tensor, draws: bool) -> GraphedFunction:
        """Capture the physics, race rules and, if ``draws``, rendering of a step as one CUDA graph; restore the worlds.

        The graph keeps the current race rules (laps, episode_steps, weights).
        """

        def fly_and_draw(action: Tensor) -> list[Tensor]:
            outcome = list(vars(self._fly(action)).values())
            return [*outcome, self.simulator.render()] if draws else outcome

        before = self.state_dict()
        try:
            graph = GraphedFunction(fly_and_draw, action)
        except RuntimeError as error:
            if self.custom_reward is None or is_out_of_memory(error):
                raise
            raise RuntimeError(
                f"{self.custom_reward.name} cannot be captured as a CUDA graph. It must use tensor operations only: no "
                f".item(), no if on a tensor, no indexing by a mask, no tensor of Python numbers. CUDA says: {error}"
            ) from error
        self.load_state_dict(before)
        return graph

    def render(self, rows: Tensor | None = None) -> Tensor:
        """Return images uint8 (M, height, width, 3) of all worlds, or of M rows: a mask (N,) bool, or indices (M,).

        Raises:
            RuntimeError: there is no renderer, or this process was forked from the one that made the worlds.
        """
        self._check_process()
        return self._draw(rows) if self._held is None else self._held.show(rows)

    def _draw(self, rows: Tensor | None) -> Tensor:
        """Return the images that the last step rendered, or render them now; then add camera noise."""
        if self._images is None:
            images = self.simulator.render(rows)
        elif rows is None:
            images, self._images = self._images, None  # now owned by the caller
        else:
            images = self._images[rows]
        looks = self.simulator.looks
        return images if looks is None else looks.add_noise(images)

    def render_at(self, position: Tensor, attitude: Tensor) -> Tensor:
        """Return images uint8 (M, height, width, 3) at given positions (M, 3), m, and attitudes (M, 4), wxyz.

        They are rendered in the halls of worlds 0, 1, …; the state of the worlds is restored afterwards.
        """
        self._check_process()
        before, state = self.simulator.state_dict(), self.simulator.state
        parts = []
        for place, turned in zip(position.split(self.num_envs), attitude.split(self.num_envs), strict=True):
            state.position[: len(place)], state.attitude[: len(place)] = place, turned
            parts.append(self.simulator.render()[: len(place)].clone())
        self.simulator.load_state_dict(before)
        return torch.cat(parts)

    def privileged(self) -> dict[str, Tensor]:
        """Return copies of the privileged state; see the key table in `docs/api/environments.md`."""
        state = self.simulator.state
        return {
            **{field.name: getattr(state, field.name).to(torch.float32, copy=True) for field in fields(state)},
            "target_gate": self.race.target_gate.unsqueeze(-1).clone(),
        }

    @property
    def effort(self) -> Tensor:
        """Motor effort of the last control step, a float32 copy (N, 3); see `Quadrotor`."""
        return self.simulator.quadrotor.effort.to(torch.float32, copy=True)

    def vector(self) -> Tensor:
        """Return the race vector in each drone's body frame, float32 (N, 21); see `RaceVector`."""
        return self.race_vector(self.simulator.state, self.race.target_gate)

    def race_state(self) -> RaceState:
        """Return copies of the state that user-defined functions are given."""
        return RaceState.of(self.race, self.race_vector, self.simulator.state, self._last_action)

    def observed_vector(self) -> Tensor:
        """Return the observation `vector`, float32 (N, V): the user-defined function's, or the race vector."""
        return self.vector() if self.custom_vector is None else self.custom_vector.vector(self.race_state())

    def _parts(self) -> dict[str, Any]:
        """Return what has a state of its own, by its key in `state_dict`."""
        parts = {"simulator": self.simulator, "race": self.race, "frames": self._held, "imu": self.imu}
        return {name: part for name, part in parts.items() if part is not None}

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state that future steps and episodes depend on, for `torch.save`."""
        last_action = {"last_action": self._last_action.clone()} if self._tracks_last_action else {}
        states = {name: part.state_dict() for name, part in self._parts().items()}
        return {**states, "generator": self._generator.get_state(), **last_action}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: the saved number of worlds, `camera_rate`, `imu` or device type differs.
        """
        saved = len(state_dict["race"]["target_gate"])
        if saved != self.num_envs:
            raise ValueError(
                f"The saved state has {saved} worlds, but there are {self.num_envs} here: resume with num_envs={saved}."
            )
        parts = self._parts()
        for name, setting in (("frames", "camera_rate"), ("imu", "imu")):
            if (name in state_dict) != (name in parts):
                raise ValueError(f"The saved worlds had another {setting}: resume with the same one.")
        if self._tracks_last_action and "last_action" in state_dict:
            self._last_action.copy_(state_dict["last_action"])
        self.has_reset = True
        generator = state_dict["generator"].cpu()
        if generator.shape != self._generator.get_state().shape:
            saved_on = "cpu" if self.device.type == "cuda" else "cuda"
            raise ValueError(
                f"The saved worlds were on {saved_on}, these are on {self.device.type}, where random numbers "
                f"differ: resume with device={saved_on} (of the worlds; in recipes env.device={saved_on})."
            )
        for name, part in parts.items():
            part.load_state_dict(state_dict[name])
        self._images = None
        self._generator.set_state(generator)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled, as simulators and their OpenGL contexts cannot be."""
        raise TypeError(
            "Worlds cannot be copied or pickled: make new ones with the same arguments. To transfer the state of "
            "a DroneRacingEnv, use state_dict() and load_state_dict()."
        )

    def close(self) -> None:
        """Free rendering contexts and threads; in a forked process they are left to the parent."""
        self._graphs.clear()  # they write into the simulator's buffers
        self._images = None
        if os.getpid() == self._process:
            self.simulator.close()


def _check_counts(num_envs: int, **others: int | None) -> None:
    """Refuse numbers that are not whole, where they are given, and no worlds."""
    check_numbers({"num_envs": num_envs, **without_none(**others)}, {})
    if num_envs < 1:
        raise ValueError(f"num_envs={num_envs}: at least one world is needed.")
