"""`DroneRacingEnv`: the race as a natively batched TorchRL environment.

Keys, shapes and units: `docs/api/environments.md`. Shapes: N environments.
"""

from collections.abc import Mapping
from typing import Any, Unpack

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.imu import IMU_SIZE
from dreamer_racing.envs.race.race import RACE_VECTOR_SIZE
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import ACTION_SIZE, RaceOptions, RaceWorlds, check_options
from dreamer_racing.settings import check_flags


class DroneRacingEnv(EnvBase):
    """N drones racing in parallel in one process, without ParallelEnv.

    Args:
        track: name of a built-in track, path to a YAML file, or a `Track`.
        num_envs: N; the batch size is [N].
        device: device of the worlds and all tensors, `cpu` or a CUDA device; see `RaceWorlds`.
        from_pixels: whether to observe `pixels`; if not, `vector` instead, see `RaceVector`. A user-defined `vector=`
            is observed in either case.
        privileged: whether there are `("privileged", ...)` entries.
        preset: physics preset (`easy`, `faithful`, `betaflight`) or parameters.
        seed: seed of start poses and of the randomisation of physics and looks, one stream for all drones.
        worlds: further arguments of `RaceWorlds`, see `RaceOptions`.

    Attributes:
        body_rate_weight: b₂ of paper Eq. 1, applied to rewards from now on; the curriculum sets it.

    Example:
        >>> env = DroneRacingEnv(track="circle", num_envs=4, from_pixels=False, seed=0)
        >>> env.rollout(10, break_when_any_done=False)["next", "reward"].shape
        torch.Size([4, 10, 1])
    """

    def __init__(
        self,
        track: str | Track = "kidney",
        num_envs: int = 16,
        device: torch.device | str = "cpu",
        from_pixels: bool = True,
        privileged: bool = True,
        preset: str | QuadrotorParameters = "easy",
        seed: int | None = None,
        **worlds: Unpack[RaceOptions],
    ) -> None:
        # before TorchRL raises its own error for unknown arguments
        check_options(DroneRacingEnv, worlds, RaceOptions)
        check_flags(privileged=privileged)
        race = RaceWorlds(track, num_envs, preset, from_pixels=from_pixels, device=device, seed=seed, **worlds)
        super().__init__(device=device, batch_size=[race.num_envs])
        self.from_pixels = from_pixels
        self.privileged = privileged
        self.worlds = race
        self.track = race.track
        self.body_rate_weight = self.worlds.race.weights.body_rate
        self._make_specs()
        self.is_closed = False  # by default TorchRL regards an unwrapped environment as closed

    def _make_specs(self) -> None:
        n = self.batch_size

        def number(*shape: int, dtype: torch.dtype = torch.float32) -> Unbounded:
            return Unbounded((*n, *shape), dtype=dtype, device=self.device)

        def flag() -> Bounded:
            return Bounded(0, 1, (*n, 1), dtype=torch.bool, device=self.device)

        self.action_spec = Bounded(-1.0, 1.0, (*n, ACTION_SIZE), dtype=torch.float32, device=self.device)
        self.reward_spec = number(1)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=n, device=self.device)
        race = Composite(
            gates_passed=number(1, dtype=torch.int64),
            gate_offset=number(1),
            lap_time=number(1),
            crash=number(1, dtype=torch.int64),
            finished=flag(),
            target_gate=number(1, dtype=torch.int64),
            shape=n,
            device=self.device,
        )
        observation = Composite(reward_base=number(1), body_rate_norm=number(1), race=race, shape=n, device=self.device)
        self._before_the_race = observation.zero()
        if self.from_pixels:
            camera = self.worlds.camera
            observation["pixels"] = Bounded(
                0, 255, (*n, camera.height, camera.width, 3), dtype=torch.uint8, device=self.device
            )
        if not self.from_pixels or self.worlds.custom_vector is not None:
            observation["vector"] = number(self.worlds.vector_size)
        if self.worlds.imu is not None:
            observation["imu"] = number(IMU_SIZE)
        if self.privileged:
            observation["privileged"] = Composite(
                position=number(3),
                attitude=number(4),
                linear_velocity=number(3),
                body_rates=number(3),
                target_gate=number(1, dtype=torch.int64),
                vector=number(RACE_VECTOR_SIZE),
                shape=n,
                device=self.device,
            )
        self.observation_spec = observation

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        mask = None if mask is None else mask.view(self.batch_size)
        self.worlds.reset(mask)
        data = self._before_the_race.clone().update(self._observe())
        if self.from_pixels:
            data.set("pixels", self._draw(mask))
        return data

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        outcome = self.worlds.step(tensordict["action"])
        names = ("gates_passed", "gate_offset", "lap_time", "crash", "finished", "target_gate")
        data = {
            "reward_base": self._column(outcome.reward_base),
            "body_rate_norm": self._column(outcome.body_rate_norm),
            "race": self._group({name: self._column(getattr(outcome, name)) for name in names}),
            "reward": self._column(outcome.reward(self.body_rate_weight)),
            "done": self._column(outcome.terminated | outcome.truncated),
            "terminated": self._column(outcome.terminated),
            "truncated": self._column(outcome.truncated),
            **self._observe(),
        }
        if self.from_pixels:
            data["pixels"] = self.worlds.render()
        return self._group(data)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reset ended episodes in place, like ``EnvBase`` but without merging two observations.

        The states of all worlds are read again, as those that fly on are unchanged; images are rendered only for the
        rows that were reset. All other keys, of the race or of a policy, are zero where an episode begins (``EnvBase``:
        unless all begin together). On a CUDA device it synchronises once, to count the ended episodes.
        """
        if not self.has_step_keys(tensordict):
            return super().maybe_reset(tensordict)
        ended = tensordict.get("done").squeeze(-1)
        rows = ended.nonzero().squeeze(-1)
        if not len(rows):
            return tensordict
        self.worlds.reset(None if len(rows) == len(ended) else ended)
        seen = self._observe()
        if self.from_pixels:
            seen["pixels"] = tensordict.get("pixels").clone()  # the previous step keeps its own images
            seen["pixels"][rows] = self.worlds.render(rows)
        for key, value in list(tensordict.items(include_nested=True, leaves_only=True)):
            if (key if isinstance(key, str) else key[0]) not in seen:
                tensordict.set(key, value.masked_fill(ended.view(-1, *[1] * (value.ndim - 1)), 0))
        return tensordict.update(seen)

    def has_step_keys(self, tensordict: TensorDictBase) -> bool:
        """Return whether data have the keys that a step of this environment returns."""
        return "done" in tensordict and not (self.from_pixels and "pixels" not in tensordict)

    def _column(self, values: Tensor) -> Tensor:
        """Reshape (N,) to (N, 1), with floats as float32."""
        values = values.unsqueeze(-1)
        return values.float() if values.is_floating_point() else values

    def _group(self, data: dict[str, Any]) -> TensorDict:
        """Return the entries of all worlds as one TensorDict [N]."""
        return TensorDict(data, self.batch_size, device=self.device)

    def _observe(self) -> dict[str, Any]:
        """Return the current observations without images."""
        data: dict[str, Any] = {} if self.worlds.imu is None else {"imu": self.worlds.imu.sample}
        if not self.from_pixels or self.worlds.custom_vector is not None:
            data["vector"] = self.worlds.observed_vector()
        if self.privileged:
            race = data["vector"] if "vector" in data and self.worlds.custom_vector is None else self.worlds.vector()
            data["privileged"] = self._group({**self.worlds.privileged(), "vector": race})
        return data

    def _draw(self, mask: Tensor | None) -> Tensor:
        """Return images (N, H, W, 3); after a partial reset only the masked rows are rendered, the others are black."""
        images = self.worlds.render(mask)
        if mask is None:
            return images
        everyone = images.new_zeros((*self.batch_size, *images.shape[1:]))
        everyone[mask] = images
        return everyone

    def _set_seed(self, seed: int | None) -> None:
        self.worlds.seed(seed)

    def state_dict(self) -> dict[str, Any]:
        """Return the state with which an environment with the same arguments continues bit for bit like this one."""
        return {"worlds": self.worlds.state_dict(), "body_rate_weight": self.body_rate_weight}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: it does not fit these worlds, for example has another number of them.
        """
        self.worlds.load_state_dict(state_dict["worlds"])
        self.body_rate_weight = state_dict["body_rate_weight"]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free rendering contexts and threads."""
        if not self.is_closed:
            self.worlds.close()
        super().close(raise_if_closed=raise_if_closed)
