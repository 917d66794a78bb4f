"""Every number of the losses, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamer_racing.modules.heads import MAX_STD, MIN_STD
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, setting

HORIZON = 16
"""H, imagined actions from each start, where nobody says; in recipes ``model.imagination_horizon`` does.
Reference: Dream to Fly, where T = 16; danijar/dreamerv3 has 15 (``imag_length``)."""
KL_TOLERANCE = 1.5
"""Factor that a divergence may be off its target. Reference: Schulman et al. 2017, Section 4."""


@dataclass
class PPOUpdateConfig:
    """Numbers of an update on collected steps, of the actor and of its critic [choice, unless a source is named].

    Attributes:
        steps: Collected ones, summed over environments, that one update of the actor learns from.
        epochs: Times that every step is trained on.
        minibatch: M, steps of a gradient step.
        clip_epsilon: ε of the clipped ratio. Reference: Schulman et al. 2017.
        advantage_clip: Largest normalised advantage.
        kl_stop: Divergence KL(before ‖ now) of what the update's own steps did, nats, beyond which the remaining
            minibatches are left out.
        kl_target: The same before an update's last gradient step, nats, to which the learning rate is steered:
            1.5 times more, and the next update is made at a lower one, 1.5 times less, and at a higher one; None: it
            stays. Reference: Schulman et al. 2017, Section 4, who steer the weight of a KL penalty so.
        learning_rate: Of the actor's Adam; the largest, where there is a ``kl_target``.
        critic_learning_rate: Of the critic's.
        gradient_clip: Largest norm of the gradient, of the actor or that critic.
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
    """Numbers of the losses that every algorithm with a world model has.

    Attributes:
        world_model: What shapes the latents beside rewards, a name of ``dreamer_racing.losses.TARGETS``:
            ``reconstruction``, ``informed``, ``privileged``, ``decoder_free`` or ``reward_only``; or ``module:Class``
            of your own; several are joined by ``+``.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the actor's entropy.
        min_std: Smallest standard deviation of actions. The reference has 0.1; more keeps the actor exploring where a
            first way of doing something has made it sure of itself.
        max_std: Largest standard deviation of actions. The reference has 1.
        dynamics_scale: Weight of the dynamics loss.
        representation_scale: Weight of the representation loss.
        free_nats: KL, summed over latents, below which there is no gradient, nats.
        image_scale: Weight of the images' reconstruction: ``reconstruction`` and ``informed``. The reference has 1.
        image_share: Share of a window's records, at least one, whose images are decoded, drawn anew in every update;
            the reference decodes all. Less makes an update cheaper.
        privileged_scale: Weight of decoding the simulator's state: ``informed`` and ``privileged``.
        barlow_scale: Weight of the redundancy reduction: ``decoder_free``.
        drift_scale: Weight of ``policy_drift``, where a replay keeps latents that are not drawn
            (``replay.context=true``, ``model.sampled=false``); 0 turns it off.
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
    privileged_scale: float = setting(1.0, NOT_NEGATIVE)
    barlow_scale: float = setting(0.05, NOT_NEGATIVE)
    drift_scale: float = setting(0.0, NOT_NEGATIVE)
    slow_critic_scale: float = setting(1.0, NOT_NEGATIVE)
    replay_value_scale: float = setting(0.3, NOT_NEGATIVE)
    replay_value_gradient: bool = True


@dataclass
class DreamerV3Losses(LossConfig):
    """And those of an actor that learns in imagination.

    Attributes:
        actor: Its objective: ``reinforce``, ``dynamics``, or ``module:function`` of your own.
        return_decay: Decay of the moving percentiles of returns.
        continuation: Whether predicted ends of episodes cut imagined returns.
        open_loop_steps: Steps ahead for which rewards and ends are learned from replayed actions alone, as imagination
            reads them (`open_loop_loss`); 0, as in the reference: only where latents were observed.
        action_change_scale: Weight of the squared change of the policy's mean from one imagined step to the next
            (`Trajectory.action_change`) in the actor's loss; the reference has none.
        actor_begin: Updates after which the actor begins to learn. The gradient of the dynamics is followed as surely
            where the model is wrong: an actor that begins with the model is soon saturated. The reference has 0.
    """

    actor: str = "reinforce"
    return_decay: float = setting(0.99, SHARE)
    continuation: bool = True
    open_loop_steps: int = setting(0, NOT_NEGATIVE)
    action_change_scale: float = setting(0.0, NOT_NEGATIVE)
    actor_begin: int = setting(0, NOT_NEGATIVE)


@dataclass
class LatentPPOLosses(LossConfig):
    """And those of an actor that learns from what was collected.

    Attributes:
        actor: Its objective: ``clipped``, or ``module:function`` of your own.
        critic: What the critic that teaches the actor sees: ``latent``, the world model's latents, or ``state``, the
            simulator's state, which only training needs.
        ppo: Numbers of the updates of both.
    """

    actor: str = "clipped"
    critic: str = "latent"
    ppo: PPOUpdateConfig = field(default_factory=PPOUpdateConfig)
