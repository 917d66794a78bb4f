"""The SAC learner: networks, TorchRL's loss, and one gradient step on replayed transitions.

Shape legend: B batch, A action.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from dreamer_racing.learners.baseline import BaselineLearner, NetworkModule, NetworkSize, ObservationNetwork, make_actor
from dreamer_racing.learners.learner import Timer, seeded, untimed
from dreamer_racing.modules import Interface
from dreamer_racing.settings import COUNT, POSITIVE, SHARE, check_settings, setting

NO_WEIGHT = 1e-30  # negligible beside a transition's weight of 1, but a sum of such weights is not 0


@dataclass
class SACConfig:
    """Settings of the SAC learner.

    Attributes:
        learning_rate: Learning rate of Adam for actor, critics and temperature.
        batch_size: B, number of transitions in a batch.
        replay_ratio: Transitions trained on per environment step.
        discount: γ.
        target_rate: Fraction by which the target critics move towards the critics at each update.
        initial_alpha: Initial temperature, which is learned towards an entropy of −A nats.
        reward_scale: Factor on rewards.

    Reference: Haarnoja et al. 2018, "Soft actor-critic algorithms and applications"; numbers of Stable-Baselines3,
    except batch size and replay ratio (for many environments), temperature and scale of rewards [choice].
    """

    learning_rate: float = setting(3e-4, POSITIVE)
    batch_size: int = setting(1024, COUNT)
    replay_ratio: float = setting(16.0, POSITIVE)
    discount: float = setting(0.99, SHARE)
    target_rate: float = setting(0.005, SHARE)
    initial_alpha: float = setting(0.05, POSITIVE)
    reward_scale: float = setting(1.0, POSITIVE)


class SACLearner(BaselineLearner):
    """Actor and two critics with TorchRL's ``SACLoss``, and one optimiser.

    Args:
        size: Size of all networks.
        interface: Observations and actions of the agent.
        config: Settings of the learner.
        device: Where the networks live and updates run.
        seed: Seed of the initial weights; None draws them from the global generator.

    Example:
        >>> learner = SACLearner(NetworkSize(2, 32), Interface(pixels=False, vector_dim=21), seed=0)
        >>> learner.policy().in_keys
        ['vector']
    """

    def __init__(
        self,
        size: NetworkSize,
        interface: Interface,
        config: SACConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        super().__init__(size, interface, device)
        self.config = config or SACConfig()
        check_settings(self.config)
        with seeded(seed):  # mean and standard deviation depend on the observation; tanh squashes into [−1, 1]
            network = ObservationNetwork(interface, 2 * interface.action_dim, size, output_scale=0.01)
            self.actor = make_actor(network, NormalParamExtractor(), TanhNormal).to(self.device)
            critic = ObservationNetwork(interface, 1, size, with_action=True)
            self._loss = SACLoss(
                self.actor,
                NetworkModule(critic, ["state_action_value"]),
                alpha_init=self.config.initial_alpha,
                target_entropy=-float(interface.action_dim),
                loss_function="l2",
                deactivate_vmap=True,
            ).to(self.device)
        self._loss.make_value_estimator(gamma=self.config.discount)
        self._targets = SoftUpdate(self._loss, tau=self.config.target_rate)
        self.networks = {
            "actor": list(self.actor.parameters()),
            "critic": list(self._loss.qvalue_network_params.values(True, True)),
        }
        trained = [*self.networks["actor"], *self.networks["critic"], self._loss.log_alpha]
        self.optimizer = torch.optim.Adam(trained, lr=self.config.learning_rate, fused=True)

    def update(self, windows: TensorDictBase, timed: Timer = untimed) -> dict[str, Tensor]:
        """Make one gradient step.

        Args:
            windows: Replay records ``[B, 2]``, see `transitions`.
            timed: Context manager by activity (``optimise``).

        Returns:
            Losses and diagnostics, scalar tensors on the device.

        Raises:
            NonFiniteLossError: If a loss or gradient is not finite.
        """
        with timed("optimise"):
            batch = self.transitions(windows.to(self.device, non_blocking=True))
            outputs = self._loss(batch)
            total = outputs["loss_actor"] + outputs["loss_qvalue"] + outputs["loss_alpha"]
            metrics = self._gradient_step(total, outputs, batch)
            self._targets.step()
        return metrics

    def transitions(self, windows: TensorDictBase) -> TensorDict:
        """Make transitions ``[B]`` from windows of two records.

        If the second record begins an episode, there is no transition: its weight is ``NO_WEIGHT`` instead of 0, so
        that the weighted mean of a batch without any transition is still defined.
        """
        before, after = windows[:, 0], windows[:, 1]
        following = {key: after.get(key) for key in (*self._keys, "terminated", "truncated")}
        following["done"] = following["terminated"] | following["truncated"]
        following["reward"] = after.get("reward") * self.config.reward_scale
        return TensorDict(
            {
                **{key: before.get(key) for key in self._keys},
                "action": after.get("previous_action"),
                "next": following,
                "priority_weight": (~after.get("is_init").squeeze(-1)).float().clamp(min=NO_WEIGHT),
            },
            windows.batch_size[:1],
        )

    def _modules(self) -> dict[str, nn.Module]:
        return {"loss": self._loss}
