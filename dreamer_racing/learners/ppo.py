"""The PPO learner: networks, TorchRL's clipped loss, and the gradient steps on one rollout.

Shape legend: N environments, T steps of a rollout, M records of a minibatch, A action.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from dreamer_racing.learners.baseline import BaselineLearner, NetworkModule, NetworkSize, ObservationNetwork, make_actor
from dreamer_racing.learners.learner import Timer, ValueFunction, seeded, untimed
from dreamer_racing.modules import Interface
from dreamer_racing.modules.heads import clipped_mean
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, check_settings, setting


@dataclass
class PPOConfig:
    """Settings of the PPO learner.

    Attributes:
        learning_rate: Learning rate of Adam.
        epochs: Number of passes over each rollout.
        minibatches: Gradient steps per epoch.
        clip_epsilon: ε of the clipped ratio.
        discount: γ.
        lambda_: λ of the advantages.
        entropy_scale: Weight of the policy's entropy.
        critic_scale: Weight of the critic's squared error.
        reward_scale: Factor on the rewards that the critic learns from, so that its errors are of order one.
        gradient_clip: Maximum norm of a network's gradient; actor and critic are clipped separately.
        initial_std: Initial standard deviation of the actions; one learned number for each dimension.

    Reference: Schulman et al. 2017, "Proximal policy optimization algorithms". Clipping, discount, λ and the weights of
    the losses are the defaults of Stable-Baselines3; learning rate, epochs, minibatches, scale of rewards and initial
    standard deviation are [choice].
    """

    learning_rate: float = setting(1e-3, POSITIVE)
    epochs: int = setting(5, COUNT)
    minibatches: int = setting(8, COUNT)
    clip_epsilon: float = setting(0.2, POSITIVE)
    discount: float = setting(0.99, SHARE)
    lambda_: float = setting(0.95, SHARE)
    entropy_scale: float = setting(0.0, NOT_NEGATIVE)
    critic_scale: float = setting(0.5, NOT_NEGATIVE)
    reward_scale: float = setting(0.1, POSITIVE)
    gradient_clip: float = setting(0.5, POSITIVE)
    initial_std: float = setting(0.6, POSITIVE)

    def check(self, num_envs: int, rollout_steps: int) -> None:
        """Refuse more minibatches than a rollout has records."""
        records = num_envs * rollout_steps
        if self.minibatches > records:
            raise ValueError(
                f"ppo.minibatches={self.minibatches} are more than the {records} records of a rollout, env.num_envs="
                f"{num_envs} times rollout_steps={rollout_steps}: lower the one, or raise the others."
            )


class PPOLearner(BaselineLearner):
    """Actor and critic with TorchRL's ``ClipPPOLoss``, and one optimiser.

    Actions are sampled from an unbounded normal distribution; the environment clips them to [−1, 1].

    Args:
        size: Size of both networks.
        interface: Observations and actions of the agent.
        config: Settings of the learner.
        device: Where the networks live and updates run.
        seed: Seed of the initial weights; None draws them from the global generator.

    Example:
        >>> learner = PPOLearner(NetworkSize(2, 32), Interface(pixels=False, vector_dim=21), seed=0)
        >>> learner.policy().in_keys
        ['vector']
    """

    def __init__(
        self,
        size: NetworkSize,
        interface: Interface,
        config: PPOConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        super().__init__(size, interface, device)
        self.config = config or PPOConfig()
        check_settings(self.config)
        with seeded(seed):  # the actor's mean depends on the observation, its standard deviation does not
            network = ObservationNetwork(interface, interface.action_dim, size, output_scale=0.01)
            deviation = AddStateIndependentNormalScale(
                interface.action_dim, init_value=math.log(self.config.initial_std)
            )
            self.actor = make_actor(network, deviation, ClippedNormal).to(self.device)
            self.critic = NetworkModule(ObservationNetwork(interface, 1, size), ["state_value"]).to(self.device)
        self._loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=self.config.clip_epsilon,
            entropy_coeff=self.config.entropy_scale,
            entropy_bonus=self.config.entropy_scale > 0,
            critic_coeff=self.config.critic_scale,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.networks = {"actor": list(self.actor.parameters()), "critic": list(self.critic.parameters())}
        trained = [parameter for parameters in self.networks.values() for parameter in parameters]
        self.optimizer = torch.optim.Adam(trained, lr=self.config.learning_rate, eps=1e-5, fused=True)

    def update(self, rollout: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make ``epochs`` passes of gradient steps over a rollout.

        Args:
            rollout: A collector's rollout ``[N, T]``.
            timed: Context manager by activity (``advantages``, ``optimise``).

        Returns:
            Losses and diagnostics, scalar tensors on the device, averaged over the gradient steps.

        Raises:
            NonFiniteLossError: If a loss or gradient is not finite.
            ValueError: If there are fewer records than minibatches.
        """
        if rollout.numel() < self.config.minibatches:
            raise ValueError(
                f"minibatches={self.config.minibatches}: must be at most {rollout.numel()}, the rollout's records."
            )
        with timed("advantages"):
            records = self.with_advantages(rollout)
        steps: list[dict[str, Tensor]] = []
        with timed("optimise"):
            for _ in range(self.config.epochs):
                order = torch.randperm(len(records), device=self.device)
                steps += [self._step(records[indices]) for indices in order.tensor_split(self.config.minibatches)]
        return {name: torch.stack([step[name] for step in steps]).mean() for name in steps[0]}

    def value_function(self) -> ValueFunction:
        """Return the critic's values of observations, in units of the unscaled reward."""

        @torch.no_grad()
        def value(acted: TensorDictBase) -> Tensor:
            return self._values(acted.select(*self._keys).to(self.device)) / self.config.reward_scale

        return value

    @torch.no_grad()
    def with_advantages(self, rollout: TensorDictBase) -> TensorDict:
        """Return the records of a rollout ``[N T]`` with ``advantage`` and ``value_target`` ``(N T, 1)``."""
        records = rollout.select(*self._keys, "action", "action_log_prob").to(self.device)
        outcome = rollout["next"].select("reward", "done", "terminated").to(self.device)
        value, next_value = self._values_and_next(records, rollout["next"])
        advantage, target = vec_generalized_advantage_estimate(
            self.config.discount,
            self.config.lambda_,
            value,
            next_value,
            outcome["reward"] * self.config.reward_scale,
            outcome["done"],
            outcome["terminated"],
        )
        return records.update({"advantage": advantage, "value_target": target}).flatten()

    def _values_and_next(self, records: TensorDictBase, following: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the values of observations and of next observations, ``(N, T, 1)`` each.

        The next observation is that of the next step, except at the rollout's last step and at truncations, where it
        is evaluated separately; after a termination its value does not matter. So few images are evaluated twice.
        """
        value = self._values(records.flatten()).view(*records.shape, 1)
        next_value = torch.cat((value[:, 1:], value[:, -1:]), 1)
        apart = following["done"].squeeze(-1).clone()
        apart[:, -1] = True
        apart &= ~following["terminated"].squeeze(-1)  # (N, T)
        others = following.select(*self._keys)[apart].to(self.device)
        next_value[apart.to(self.device)] = self._values(others)
        return value, next_value

    def _values(self, records: TensorDictBase) -> Tensor:
        """Return the values ``(N, 1)`` of records ``[N]``, in chunks, because a rollout of images is large."""
        seen, size = records.select(*self._keys), max(1, math.ceil(len(records) / self.config.minibatches))
        starts = range(0, max(1, len(records)), size)
        return torch.cat([self.critic(seen[start : start + size])["state_value"] for start in starts])

    def _step(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make one gradient step on a minibatch ``[M]``."""
        outputs = self._loss(batch)
        total = torch.stack([value for name, value in outputs.items() if name.startswith("loss_")]).sum()
        return self._gradient_step(total, outputs, batch, self.config.gradient_clip)

    def _modules(self) -> dict[str, nn.Module]:
        return {"actor": self.actor, "critic": self.critic}


class ClippedNormal(IndependentNormal):
    """Normal distribution whose deterministic sample is the mean of its samples clipped to [−1, 1]."""

    @property
    def deterministic_sample(self) -> Tensor:
        """Mean of the clipped actions, ``(..., A)``."""
        return clipped_mean(self.base_dist.loc, self.base_dist.scale)
