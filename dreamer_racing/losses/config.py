"""Configuration of the losses."""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamer_racing.modules.heads import MAX_STD, MIN_STD
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, Range, setting

HORIZON = 16
"""Default of H, imagined actions from each start; recipes set ``model.imagination_horizon``.
Reference: Dream to Fly, where T = 16; danijar/dreamerv3 has 15 (``imag_length``)."""
KL_TOLERANCE = 1.5
"""Factor by which a KL divergence may differ from its target. Reference: Schulman et al. 2017, Section 4."""


@dataclass
class PPOUpdateConfig:
    """Settings of PPO updates of the actor and its critic on collected steps [choice, unless a source is named].

    Attributes:
        steps: Number of collected steps, summed over environments, per PPO update.
        epochs: Number of passes over these steps.
        minibatch: M, steps per minibatch.
        clip_epsilon: ε of the clipped ratio. Reference: Schulman et al. 2017.
        advantage_clip: Largest absolute value of a normalised advantage.
        kl_stop: KL divergence KL(before ‖ now) of the policy within an update, nats, above which the update's remaining
            minibatches are skipped.
        kl_target: Target of that divergence before an update's last gradient step, nats. If the divergence is more than
            1.5 times the target, the next update has a lower learning rate; if it is less than the target / 1.5, a
            higher one. None keeps the rate. Reference: Schulman et al. 2017, Section 4 (there of a KL penalty).
        learning_rate: Learning rate of the actor's Adam; with a ``kl_target``, its maximum.
        critic_learning_rate: Learning rate of the critic's Adam.
        gradient_clip: Maximum norm of the gradient, of the actor and of the critic.
    """

    steps: int = setting(8_192, COUNT)
    epochs: int = setting(3, COUNT)
    minibatch: int = setting(4096, COUNT)
    clip_epsilon: float = setting(0.2, POSITIVE)
    advantage_clip: float = setting(5.0, POSITIVE)
    kl_stop: float = setting(0.03, POSITIVE)
    kl_target: float | None = setting(None, POSITIVE)
    learning_rate: float = setting(3e-4, POSITIVE)
    critic_learning_rate: float = setting(1e-3, POSITIVE)
    gradient_clip: float = setting(0.5, POSITIVE)


@dataclass
class LossConfig:
    """Settings of the losses that every algorithm with a world model has.

    Attributes:
        world_model: Targets that shape the latents besides rewards, a name of ``dreamer_racing.losses.TARGETS``:
            ``reconstruction``, ``informed``, ``privileged``, ``decoder_free`` or ``reward_only``; or your own
            ``module:Class``. Several are joined by ``+``.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the actor's entropy.
        min_std: Smallest standard deviation of actions. The reference has 0.1; a larger one keeps the actor exploring
            after it has converged to a first solution.
        max_std: Largest standard deviation of actions. The reference has 1.
        dynamics_scale: Weight of the dynamics loss.
        representation_scale: Weight of the representation loss.
        free_nats: KL divergence, summed over latents, below which there is no gradient, nats.
        image_scale: Weight of the image reconstruction in ``reconstruction`` and ``informed``. The reference has 1.
        image_share: Share of a window's records, at least one, whose images are decoded; drawn at random in each
            update. The reference decodes all; fewer make an update cheaper.
        privileged_scale: Weight of decoding the simulator's state in ``informed`` and ``privileged``.
            At 1 the KL divergence stays at 1.6 nats and the state is predicted far worse.
        barlow_scale: Weight of the redundancy reduction in ``decoder_free``.
        drift_scale: Weight of ``policy_drift``; needs stored latents that are not sampled (``replay.context=true``,
            ``model.sampled=false``). 0 turns it off.
        slow_critic_scale: Weight of the critic's regularisation towards its slow copy.
        replay_value_scale: Weight of the critic's loss on replayed returns; 0 turns it off.
        replay_value_gradient: Whether that loss also trains the world model's representation, as in the reference.

    Reference: danijar/dreamerv3, ``configs.yaml``.
    """

    world_model: str = "reconstruction"
    discount: float = setting(0.997, SHARE)
    lambda_: float = setting(0.95, SHARE)
    entropy_scale: float = setting(3e-4, NOT_NEGATIVE)
    min_std: float = setting(MIN_STD, POSITIVE_SHARE)
    max_std: float = setting(MAX_STD, POSITIVE_SHARE)
    dynamics_scale: float = setting(1.0, NOT_NEGATIVE)
    representation_scale: float = setting(0.1, NOT_NEGATIVE)
    free_nats: float = setting(1.0, NOT_NEGATIVE)
    image_scale: float = setting(1.0, NOT_NEGATIVE)
    image_share: float = setting(1.0, POSITIVE_SHARE)
    privileged_scale: float = setting(50.0, NOT_NEGATIVE)
    barlow_scale: float = setting(0.05, NOT_NEGATIVE)
    drift_scale: float = setting(0.0, NOT_NEGATIVE)
    slow_critic_scale: float = setting(1.0, NOT_NEGATIVE)
    replay_value_scale: float = setting(0.3, NOT_NEGATIVE)
    replay_value_gradient: bool = True


@dataclass
class DreamerV3Losses(LossConfig):
    """Settings of the losses of DreamerV3, whose actor learns in imagination.

    Attributes:
        actor: Objective of the actor: ``reinforce``, ``dynamics``, or your own ``module:function``.
        return_decay: Decay of the moving percentiles of returns.
        continuation: Whether predicted ends of episodes cut imagined returns.
        open_loop_steps: Steps over which rewards and episode ends are also predicted from replayed actions alone, as in
            imagination (`open_loop_loss`). 0, as in the reference, learns them only at observed latents.
        action_change_scale: Weight of the squared change of the policy's mean from one imagined step to the next
            (`Trajectory.action_change`) in the actor's loss; the reference has none.
        averaged_kl_scale: Weight of KL(averaged ‖ current), the divergence of the policy from that of the averaged
            weights, in the actor's loss; needs ``model.average_rate``. It is meant to make the actor follow errors
            of its world model more slowly. The reference has none. Vieillard et al. 2020, "Leverage the average".
        crash_weight: Power of the predicted probability that an imagined episode continues: a small risk of a crash
            counts this many times, and the actor flies with more caution. Values are then below the
            expected returns. The reference has 1.
        actor_begin: Number of updates before the actor starts to learn. The gradient through the dynamics is misleading
            while the model is wrong: an actor that starts with the model soon saturates. The reference has 0.
    """

    actor: str = "reinforce"
    return_decay: float = setting(0.99, SHARE)
    continuation: bool = True
    open_loop_steps: int = setting(0, NOT_NEGATIVE)
    action_change_scale: float = setting(0.0, NOT_NEGATIVE)
    averaged_kl_scale: float = setting(0.0, NOT_NEGATIVE)
    crash_weight: float = setting(1.0, Range(1))
    actor_begin: int = setting(0, NOT_NEGATIVE)


@dataclass
class LatentPPOLosses(LossConfig):
    """Settings of the losses of latent PPO, whose actor learns from collected rollouts.

    Attributes:
        actor: Objective of the actor: ``clipped``, or your own ``module:function``.
        critic: Input of PPO's critic: ``latent`` for the world model's latents, ``state`` for the simulator's state,
            which is only needed in training.
        ppo: Settings of the PPO updates of actor and critic.
    """

    actor: str = "clipped"
    critic: str = "latent"
    ppo: PPOUpdateConfig = field(default_factory=PPOUpdateConfig)
