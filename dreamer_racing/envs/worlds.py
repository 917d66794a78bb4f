"""`RaceWorlds`: simulator, race rules and start poses put together, N drones on N copies of a track.

The TorchRL and Gymnasium environments are thin adapters of this class. Shapes: N worlds, A action (4). SI units.
"""

import inspect
import os
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypedDict

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import (
    QuadrotorParameters,
    at_control_rate,
    load_preset,
    without_randomisation,
)
from dreamer_racing.envs.drone.quadrotor import wrong_action_type
from dreamer_racing.envs.held_frames import HeldFrames
from dreamer_racing.envs.imu import Imu, ImuErrors, load_imu
from dreamer_racing.envs.own import OwnFunction, RaceState, RaceStates, RewardFunction, Transition, VectorFunction
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
from dreamer_racing.envs.simulator.backends import check_device, make_simulator
from dreamer_racing.envs.simulator.base import Simulator
from dreamer_racing.envs.simulator.looks import LooksRandomisation, load_looks
from dreamer_racing.envs.simulator.scene import Camera, frame_interval, load_camera
from dreamer_racing.envs.simulator.warp_device import GraphedFunction
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.machine import is_out_of_memory
from dreamer_racing.settings import (
    NOT_NEGATIVE,
    check_flags,
    check_numbers,
    check_setting,
    quoted,
    suggestion,
    without_none,
)

ACTION_SIZE = 4


class RaceOptions(TypedDict, total=False):
    """Arguments of `RaceWorlds`, which says what they mean, that every environment made of it takes and hands on."""

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
    """Those, where an environment has no `device` and `seed` of its own."""

    device: torch.device | str
    seed: int | None


def check_options(environment: type, given: Mapping[str, object], options: type) -> None:
    """Refuse arguments that an environment neither has nor hands on to `RaceWorlds`.

    In Python's own words, by which TorchRL's `GymEnv` knows that an environment takes no frameskip.

    Args:
        environment: whose `__init__` was called, with what it has no argument for.
        given: those.
        options: `RaceOptions` or `WorldOptions`.

    Raises:
        TypeError: the message names environment, argument and the nearest that there is.
    """
    own = [
        name for name in inspect.signature(vars(environment)["__init__"]).parameters if name not in ("self", "worlds")
    ]
    known = [*own, *options.__annotations__]
    for name in given:
        if name not in known:
            images = "; observation= says whether images are drawn" if name == "from_pixels" else ""
            raise TypeError(
                f"{environment.__name__} got an unexpected keyword argument {name!r}{suggestion(name, known)}{images}. "
                f"It takes {', '.join(known)}."
            )


class RaceWorlds:
    """N drones, each alone in its own copy of the race.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        num_envs: N.
        preset: physics preset (`easy`, `faithful`, `betaflight`) or parameters.
        evaluation: start at the start pose, at rest, and finish after the track's laps.
        episode_steps: control steps until an episode is truncated; if None those of 20 s, in evaluation of 30 s.
        weights: of the reward, paper Eq. 1.
        from_pixels: whether to have a renderer at all.
        renderer: `auto`, or on CPU a name out of `rendering.RENDERERS`, or `warp_cuda`: drawn on a CUDA device.
        camera: the nose camera.
        looks: `nominal`, or `randomised` for another light, colours, camera tilt, lens and noise in every episode, or
            how far each varies.
        num_threads: of physics and rendering on CPU; if None one a CPU, at most `OMP_NUM_THREADS`.
        device: `cpu` or a CUDA device, where everything lives. On CUDA a step is one graph that never waits.
        backend: `auto` (`mujoco` on CPU, `mujoco_warp` on CUDA), `mujoco`, or `mujoco_warp` (on CPU for tests: slow).
        seed: of start poses and of the randomisation of physics and looks.
        start_beyond_gate: share of training episodes, but for those on the line, that begin behind a gate; see
            `StartSampler`.
        start_at_gate: share of the others, but for those on the line, that begin before a gate instead of at the start.
        start_on_line: share of training episodes that begin on a planned racing line, which takes some seconds to plan.
        start_noise: of evaluation starts, as a multiple of the noise of training starts.
        miss_radius: training episodes end, as with a crash, where the target gate's plane is crossed beside its frame
            and less than so far from its centre, m; if 0 the drone flies on. For tracks whose way to a gate does not
            lead past it.
        action_change_weight: b₃, penalty in training for each unit of ‖aₜ − aₜ₋₁‖², but in a step that ends in a crash
            and the first of an episode; 0 as in the paper. Champion-level drone racing (Kaufmann et al., Nature 620,
            2023, Extended Data Table 1a: λ₅, with λ₁ = 1 for a metre of progress, as here) has 1e-4.
        control_rate: actions a second, Hz; if None the preset's, 50.
        camera_rate: frames a second, Hz, `control_rate` divided by a whole number: an image is shown until the next
            one, and none is drawn in between; if None the camera's, a frame at every control step.
        imu: gyro and accelerometer beside the images: `exact`, `noisy` (see `IMUS`), or by how much they err; None for
            none.
        reward: function of a `Transition` that returns the rewards (N,), in place of Eq. 1 without the penalty of body
            rates; or `module:function`; None for Eq. 1. See `docs/own_rewards.md`.
        vector: function of a `RaceState` that returns numbers (N, V) which agents see, beside images or without; or
            `module:function`; None for the race vector where there are no images.

    Raises:
        ValueError: bad argument; the message says which and what is allowed.
        TrackError: unknown or broken track.

    Example:
        >>> worlds = RaceWorlds("circle", num_envs=2, from_pixels=False)
        >>> worlds.reset()
        >>> worlds.step(torch.zeros(2, 4)).terminated.shape
        torch.Size([2])
    """

    _images: Tensor | None = None  # of all worlds as they are, where a step drew them

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
        _check_arguments(num_envs, without_none(episode_steps=episode_steps, num_threads=num_threads))
        check_flags(evaluation=evaluation, from_pixels=from_pixels)
        check_device(device)
        self.camera, errors = load_camera(camera, camera_rate, from_pixels), load_imu(imu, from_pixels)
        self._process, self._from_pixels = os.getpid(), from_pixels
        self.track, self.evaluation = load_track(track), evaluation
        self.num_envs = num_envs = int(num_envs)
        self.parameters = _load_parameters(preset, control_rate)
        interval = frame_interval(self.camera, 1.0 / self.parameters.control_dt)
        self._generator = torch.Generator(device)
        self.seed(seed)
        self.simulator: Simulator = make_simulator(
            self.track,
            self.parameters,
            num_envs,
            self.camera,
            renderer if from_pixels else None,
            num_threads,
            self._generator,
            device,
            backend,
            load_looks(looks),
        )
        self.device, self.dtype = self.simulator.device, self.simulator.dtype
        self.race = self._make_race(weights, episode_steps, miss_radius)
        self._make_numbers(errors, vector)
        self._make_rewards(action_change_weight, reward)
        self._starts = self._make_starts(start_beyond_gate, start_at_gate, start_noise, start_on_line)
        self._held = HeldFrames(interval, self._draw) if from_pixels and interval > 1 else None
        self._graphs: dict[bool, GraphedFunction] = {}  # of a control step, by whether it draws
        self.begun = False

    def _make_race(self, weights: RewardWeights | None, episode_steps: int | None, miss_radius: float) -> Race:
        """Make the rules, of training or of evaluation."""
        check_numbers({}, {"miss_radius": miss_radius})
        if episode_steps is None:
            episode_steps = round((EVALUATION_TIME if self.evaluation else EPISODE_TIME) / self.parameters.control_dt)
        return Race(
            self.track,
            self.num_envs,
            weights=weights or RewardWeights(),
            episode_steps=episode_steps,
            laps=self.track.laps if self.evaluation else None,
            control_dt=self.parameters.control_dt,
            device=self.device,  # in float32: a micrometre is enough for gates, at half the time
            miss_radius=0.0 if self.evaluation else miss_radius,
        )

    def _make_numbers(self, errors: ImuErrors | None, vector: str | VectorFunction | None) -> None:
        """Make what tells agents numbers: the IMU, and the race vector or a function of one's own."""
        if vector is not None and errors is not None:
            raise ValueError("imu= and vector=: agents see one set of numbers, leave one of them out.")
        self.imu = None if errors is None else Imu(errors, self.simulator.feel, self._generator)
        self.race_vector = RaceVector(self.track, self.device, self.dtype)
        self._states = RaceStates(self.race, self.race_vector)
        self._last_action = torch.zeros(self.num_envs, ACTION_SIZE, device=self.device)
        self.own_vector, self.vector_size = None, RACE_VECTOR_SIZE
        if vector is not None:
            self.own_vector = OwnFunction("vector", vector, self.num_envs, self.device)
            self.vector_size = self.observed_vector().shape[1]

    def _make_rewards(self, weight: float, reward: str | RewardFunction | None) -> None:
        """Set b₃, which is of training alone, and the function of one's own that pays, if there is one."""
        check_setting("action_change_weight", weight, NOT_NEGATIVE)
        self.action_change_weight = 0.0 if self.evaluation else float(weight)
        self.own_reward = None if reward is None else OwnFunction("reward", reward, self.num_envs, self.device)
        self._remembers = bool(self.action_change_weight or self.own_reward or self.own_vector)

    def _make_starts(self, beyond_gate: float, at_gate: float, noise: float, on_line: float) -> StartSampler:
        """Make the sampler of start poses, and plan the line for it if episodes begin there."""
        shares = {"start_beyond_gate": beyond_gate, "start_at_gate": at_gate, "start_on_line": on_line}
        check_numbers({}, {**shares, "start_noise": noise})
        if not 0.0 <= on_line <= 1.0:
            raise ValueError(f"start_on_line={on_line}: a share of episodes lies between 0 and 1.")
        on_line = 0.0 if self.evaluation else on_line
        line = None
        if on_line:
            line = plan_racing_line(self.track, without_randomisation(self.parameters), START_LINE)
        return StartSampler(
            self.track,
            self._generator,
            self.device,
            self.dtype,
            beyond_gate,
            noise,
            on_line=on_line,
            line=line,
            at_gate=at_gate,
        )

    @property
    def start_on_line(self) -> float:
        """Share of training episodes that begin on the racing line; settable where there was one from the start."""
        return self._starts.on_line

    @start_on_line.setter
    def start_on_line(self, share: float) -> None:
        self._starts.on_line = share

    def seed(self, seed: int | None) -> None:
        """Seed start poses and physics randomisation; None draws a seed from the operating system.

        Raises:
            ValueError: it is no whole number, or not in the range of a generator's.
        """
        check_numbers(without_none(seed=seed), {})
        if seed is not None and not 0 <= seed < 2**63:
            raise ValueError(f"seed={quoted(seed)}: must be at least 0 and below 2**63.")
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(int(seed))

    def _check_process(self) -> None:
        """Refuse to work in a child: a fork copies no threads, and whoever waits for theirs waits for ever."""
        if os.getpid() != self._process:
            raise RuntimeError(
                f"These worlds were made in process {self._process}, and process {os.getpid()} was forked from it, "
                "without the threads that fly and draw them: make them in the process that uses them, or start it by "
                "multiprocessing's 'spawn'."
            )

    def reset(self, mask: Tensor | None = None) -> None:
        """Start new episodes in the masked worlds (N,) bool; in all if None.

        Raises:
            RuntimeError: this process was forked from the one that made the worlds.
        """
        self._check_process()
        for own in filter(None, (self.own_reward, self.own_vector)):
            own.check()
        whole = mask is None
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        start = self._starts.sample(self.num_envs, self.evaluation)
        self.simulator.reset(mask, start.position, start.attitude, start.linear_velocity)
        self.race.begin(mask, start.position, start.target_gate)
        self._images, self.begun = None, True
        if self._remembers:
            self._last_action.masked_fill_(mask.unsqueeze(-1), 0.0)
        if self._held is not None:
            together = whole or (self.device.type == "cpu" and bool(mask.all()))  # elsewhere that would wait
            self._held.begin(None if together else mask)
        if self.imu is not None:
            self.imu.begin(mask)

    def step(self, action: Tensor) -> RaceStep:
        """Fly one control step. The simulator is not differentiable: no gradient goes back to the action.

        Args:
            action: (N, 4), on the worlds' device; values beyond [-1, 1] are clipped. A drone with a non-finite action
                has crashed: its episode ends and the others fly on.

        Raises:
            RuntimeError: no episode has begun, or this process was forked from the one that made the worlds.
            TypeError: not of a floating-point type.
            ValueError: wrong shape or device.
        """
        self._check_process()
        if not self.begun:
            raise RuntimeError("Step before the first reset: call reset() to begin episodes.")
        if not action.is_floating_point():
            raise wrong_action_type(action.dtype)
        action = action.detach()  # or the commands that are under way would keep every graph before them
        if action.shape != (self.num_envs, ACTION_SIZE):
            raise ValueError(
                f"Action of shape {tuple(action.shape)}: {self.num_envs} environment(s) take one of shape "
                f"({self.num_envs}, {ACTION_SIZE}): collective thrust and body rates x, y, z, each in [-1, 1]."
            )
        if action.device != self.device:
            raise ValueError(f"Action on {action.device}: these worlds live on {self.device}, and so must it.")
        outcome = self._fly(action) if self.device.type != "cuda" else self._replay(action)
        if self._held is not None:
            self._held.step()
        if self.imu is not None:
            self.imu.step()
        return outcome

    def _replay(self, action: Tensor) -> RaceStep:
        """Fly one control step as a CUDA graph, and draw where a frame is due."""
        draws = self._from_pixels and (self._held is None or self._held.next_is_frame)
        if draws not in self._graphs:
            self._graphs[draws] = self._capture(action, draws)
        outcome = list(self._graphs[draws](action))
        self._images = outcome.pop() if draws else None
        return RaceStep(*outcome)

    def _fly(self, action: Tensor) -> RaceStep:
        """Fly one control step and judge it; nothing here waits for a CUDA device."""
        invalid = ~action.isfinite().all(dim=1)
        flown = action.nan_to_num(0.0, 0.0, 0.0)
        goes_on = self.race.step_count > 0  # before the step: the first of an episode changes nothing
        before = None if self.own_reward is None else self.race_state()
        path = self.simulator.step(flown)
        outcome = self.race.step(path, self.simulator.state.body_rates, invalid)
        if not self._remembers:
            return outcome
        flown = flown.float().clamp(-1.0, 1.0)
        change = (flown - self._last_action).square().sum(1).masked_fill(~goes_on | outcome.terminated, 0.0)
        self._last_action.copy_(flown)
        if self.own_reward is not None and before is not None:
            rewards = self.own_reward.rewards(Transition(before, self.race_state(), outcome))
            outcome = replace(outcome, reward_base=rewards)
        if not self.action_change_weight:
            return outcome
        return replace(outcome, reward_base=outcome.reward_base - self.action_change_weight * change)

    def _capture(self, action: Tensor, draws: bool) -> GraphedFunction:
        """Capture physics, race and perhaps images of a step as one CUDA graph, and leave the worlds as they were.

        The graph keeps the race's rules (laps, episode_steps, weights) as they are now.
        """

        def fly_and_draw(action: Tensor) -> list[Tensor]:
            outcome = list(vars(self._fly(action)).values())
            return [*outcome, self.simulator.render()] if draws else outcome

        before = self.state_dict()
        try:
            graph = GraphedFunction(fly_and_draw, action)
        except RuntimeError as error:
            if self.own_reward is None or is_out_of_memory(error):
                raise
            raise RuntimeError(
                f"{self.own_reward.name} cannot be captured as a CUDA graph. It must compute with tensors alone: no "
                f".item(), no if on a number, no index by a mask, no tensor of Python's numbers. CUDA says: {error}"
            ) from error
        self.load_state_dict(before)
        return graph

    def render(self, rows: Tensor | None = None) -> Tensor:
        """Images uint8 (M, height, width, 3) of all worlds, or of M rows: a mask (N,) bool, or numbers (M,).

        Raises:
            RuntimeError: there are none, or this process was forked from the one that made the worlds.
        """
        self._check_process()
        return self._draw(rows) if self._held is None else self._held.show(rows)

    def _draw(self, rows: Tensor | None) -> Tensor:
        """Draw what `render` returns, if no step has yet."""
        if self._images is None:
            images = self.simulator.render(rows)
        elif rows is None:
            images, self._images = self._images, None  # the caller's from now on
        else:
            images = self._images[rows]
        looks = self.simulator.looks
        return images if looks is None else looks.add_noise(images)

    def picture(self, position: Tensor, attitude: Tensor) -> Tensor:
        """Images uint8 (M, height, width, 3) of drones elsewhere: at positions (M, 3), m, with attitudes (M, 4), wxyz.

        They show the halls of worlds 0, 1, …; the drones that fly stay where they are.
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
        """Copies of what the pixel agent must not see; see the key table in `docs/api/environments.md`."""
        state = self.simulator.state
        return {
            **{field.name: getattr(state, field.name).to(torch.float32, copy=True) for field in fields(state)},
            "target_gate": self.race.target_gate.unsqueeze(-1).clone(),
        }

    @property
    def effort(self) -> Tensor:
        """What the last control step asked of the motors, float32 (N, 3), a copy; see `Quadrotor`."""
        return self.simulator.quadrotor.effort.to(torch.float32, copy=True)

    def vector(self) -> Tensor:
        """The race in each drone's own frame, float32 (N, 21); see `RaceVector`."""
        return self.race_vector(self.simulator.state, self.race.target_gate)

    def race_state(self) -> RaceState:
        """How the race of each drone stands, as functions of one's own are given it: copies."""
        return self._states(self.simulator.state, self._last_action)

    def observed_vector(self) -> Tensor:
        """What an agent sees under `vector`, float32 (N, V): by a function of one's own, or the race vector."""
        return self.vector() if self.own_vector is None else self.own_vector.vector(self.race_state())

    def state_dict(self) -> dict[str, Any]:
        """Return all that coming steps and episodes depend on, for `torch.save`."""
        return {
            "simulator": self.simulator.state_dict(),
            "race": self.race.state_dict(),
            "generator": self._generator.get_state(),
            **({"last_action": self._last_action.clone()} if self._remembers else {}),
            **({} if self._held is None else {"frames": self._held.state_dict()}),
            **({} if self.imu is None else {"imu": self.imu.state_dict()}),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as the worlds would that returned this state.

        Raises:
            ValueError: they were of another number.
        """
        saved = len(state_dict["race"]["target_gate"])
        if saved != self.num_envs:
            raise ValueError(
                f"The saved state is of {saved} worlds, these are {self.num_envs}: resume with num_envs={saved}."
            )
        if ("frames" in state_dict) != (self._held is not None):
            raise ValueError("The saved worlds had another camera_rate than these: resume with theirs.")
        if ("imu" in state_dict) != (self.imu is not None):
            raise ValueError("The saved worlds had another imu than these: resume with theirs.")
        if self._remembers and "last_action" in state_dict:
            self._last_action.copy_(state_dict["last_action"])
        self.begun = True
        generator = state_dict["generator"].cpu()
        if generator.shape != self._generator.get_state().shape:
            saved_on = "cpu" if self.device.type == "cuda" else "cuda"
            raise ValueError(
                f"The saved state is of worlds on {saved_on}, these are on {self.device.type}, whose random numbers "
                f"differ: resume with device={saved_on} (of the worlds; in recipes env.device={saved_on})."
            )
        self.simulator.load_state_dict(state_dict["simulator"])
        self.race.load_state_dict(state_dict["race"])
        self._images = None
        if self._held is not None:
            self._held.load_state_dict(state_dict["frames"])
        if self.imu is not None:
            self.imu.load_state_dict(state_dict["imu"])
        self._generator.set_state(generator)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to be copied or pickled, as simulators and their OpenGL contexts cannot be."""
        raise TypeError(
            "Worlds cannot be copied or pickled: make others with the same arguments; the state of a DroneRacingEnv "
            "goes from one to the other by state_dict() and load_state_dict()."
        )

    def close(self) -> None:
        """Free rendering contexts and threads; a forked process has none, and leaves them to the one that made them."""
        self._graphs.clear()  # they draw into the simulator's buffers
        self._images = None
        if os.getpid() == self._process:
            self.simulator.close()


def _load_parameters(preset: str | QuadrotorParameters, control_rate: float | None) -> QuadrotorParameters:
    """Return the drone of a preset, with so many actions a second."""
    parameters = load_preset(preset)
    if control_rate is None:
        return parameters
    check_numbers({}, {"control_rate": control_rate})
    return at_control_rate(parameters, control_rate)


def _check_arguments(num_envs: int, whole: Mapping[str, object]) -> None:
    """Refuse arguments of a wrong type, before something else fails at them in its own words.

    Args:
        num_envs: N.
        whole: further ones that must be whole numbers, by name.

    Raises:
        ValueError: the message names the argument, its value and what it must be.
    """
    check_numbers({"num_envs": num_envs, **whole}, {})
    if num_envs < 1:
        raise ValueError(f"num_envs={num_envs}: at least one world is needed.")
