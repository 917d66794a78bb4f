"""What an agent sees and does, read off environments."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.modules import Interface
from dreamer_racing.modules.interface import PRIVILEGED


class SpecEnv(EnvBase):
    """Nothing but specs."""

    def __init__(self, num_envs: int, action_dim: int, **observation) -> None:
        super().__init__(batch_size=[num_envs])
        self.observation_spec = Composite(observation, shape=[num_envs])
        self.action_spec = Bounded(-1, 1, (num_envs, action_dim))
        self.reward_spec = Unbounded((num_envs, 1))

    def _reset(self, tensordict: TensorDict | None = None) -> TensorDict: ...

    def _step(self, tensordict: TensorDict) -> TensorDict: ...

    def _set_seed(self, seed: int | None) -> None: ...


def images(num_envs: int, height: int = 64, width: int = 64) -> Bounded:
    return Bounded(0, 255, (num_envs, height, width, 3), dtype=torch.uint8)


@pytest.mark.parametrize("num_envs", [1, 3])
def test_interface_of_any_environment(num_envs):
    """The last dimension counts, whatever the number of environments."""
    privileged = Composite(vector=Unbounded((num_envs, 9)), position=Unbounded((num_envs, 3)), shape=[num_envs])
    env = SpecEnv(num_envs, 2, pixels=images(num_envs), vector=Unbounded((num_envs, 5)), privileged=privileged)
    interface = Interface.of(env)
    assert interface == Interface(action_dim=2, pixels=True, vector_dim=5, privileged_dim=9)
    assert interface.observation_keys == ["pixels", "vector"]
    assert interface.replay_keys == ["pixels", "vector", PRIVILEGED]


def test_privileged_entries_other_than_the_vector_do_not_count():
    privileged = Composite(position=Unbounded((3, 3)), shape=[3])
    assert Interface.of(SpecEnv(3, 4, pixels=images(3), privileged=privileged)) == Interface()


def test_interface_of_a_transformed_environment():
    env = TransformedEnv(SpecEnv(3, 4, vector=Unbounded((3, 5))), InitTracker())
    assert Interface.of(env) == Interface(pixels=False, vector_dim=5)


def test_size_of_the_images():
    assert Interface.of(SpecEnv(3, 4, pixels=images(3, 96, 96))) == Interface(image_size=96)
    assert Interface(image_size=96).image_shape == (96, 96, 3)
    with pytest.raises(ValueError, match="48 × 32 pixels: agents see square ones"):
        Interface.of(SpecEnv(3, 4, pixels=images(3, 48, 32)))


def test_an_agent_that_sees_nothing_is_refused():
    with pytest.raises(ValueError, match="neither 'pixels' nor 'vector'"):
        Interface.of(SpecEnv(3, 4, sound=Unbounded((3, 5))))
    with pytest.raises(ValueError, match="sees nothing"):
        Interface(pixels=False)


@pytest.mark.parametrize(
    ("interface", "observation_keys", "replay_keys"),
    [
        (Interface(), ["pixels"], ["pixels"]),
        (Interface(privileged_dim=3), ["pixels"], ["pixels", PRIVILEGED]),
        (Interface(pixels=False, vector_dim=2), ["vector"], ["vector"]),
        (Interface(pixels=False, vector_dim=2, privileged_dim=3), ["vector"], ["vector", PRIVILEGED]),
        (Interface(vector_dim=2), ["pixels", "vector"], ["pixels", "vector"]),
    ],
)
def test_keys(interface, observation_keys, replay_keys):
    """The encoder never reads what is privileged."""
    assert interface.observation_keys == observation_keys
    assert interface.replay_keys == replay_keys


@pytest.mark.parametrize("privileged", [False, True])
@pytest.mark.parametrize("from_pixels", [False, True])
def test_interface_of_the_race(from_pixels, privileged):
    env = DroneRacingEnv(track="circle", num_envs=2, from_pixels=from_pixels, privileged=privileged, seed=0)
    interface = Interface.of(env)
    reset = env.reset()
    env.close()
    assert interface.action_dim == 4
    assert interface.pixels == from_pixels == ("pixels" in reset.keys())  # noqa: SIM118
    assert interface.vector_dim == (0 if from_pixels else reset["vector"].shape[-1])
    assert interface.privileged_dim == (reset[PRIVILEGED].shape[-1] if privileged else 0)
    for key in interface.replay_keys:
        assert reset[key].shape[0] == 2
