"""Every number of the losses, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamer_racing.modules.actor import MAX_STD, MIN_STD
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, setting

HORIZON = 16
"""H, imagined actions from each start, where nobody says; in recipes ``model.imagination_horizon`` does.
Reference: Dream to Fly, where T = 16; danijar/dreamerv3 has 15 (``imag_length``)."""


@dataclass
class ActorPPOConfig:
    """Numbers of the actors that learn by PPO [choice, unless a source is named].

    docs/experiments.md, entries 14 and 18, compares some.

    Attributes:
        updates: ``actor=ppo``: K, learner updates whose imagined rollouts are kept before the actor learns from them.
        flown: ``actor=flown_ppo``, ``latent_ppo``, ``asymmetric_ppo``: steps, summed over environments, that are
            flown before the actor learns from them.
        epochs: Times that every step is trained on.
        minibatch: M, steps of a gradient step.
        clip_epsilon: ε of the clipped ratio. Reference: Schulman et al. 2017.
        advantage_clip: Largest normalised advantage.
        kl_stop: Divergence KL(before ‖ now) of what the improvement's own steps did, nats, beyond which the remaining
            minibatches are left out.
        kl_target: The same before an improvement's last gradient step, nats, to which the learning rate is steered:
            1.5 times more, and the next improvement is made at a lower one, 1.5 times less, and at a higher one; None:
            it stays. Reference: Schulman et al. 2017, Section 4, who steer the weight of a KL penalty so.
        learning_rate: Of Adam; the largest, where there is a ``kl_target``.
        critic_learning_rate: ``actor=latent_ppo``, ``asymmetric_ppo``: of the critic that learns from what is flown.
        gradient_clip: Largest norm of the gradient, of the actor or that critic.
    """

    updates: int = setting(8, COUNT)
    flown: int = setting(8_192, COUNT)
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
    """Losses by the names of their registries in ``dreamer_racing.losses``, and their numbers.

    Attributes:
        world_model: ``reconstruction``, ``informed``, ``privileged``, ``decoder_free``, ``reward_only``, or
            ``module:Class`` of your own, as for the other two.
        actor: ``reinforce``, ``dynamics``, ``ppo``, ``flown_ppo``, ``latent_ppo`` or ``asymmetric_ppo``.
        critic: ``two_hot``.
        discount: γ.
        lambda_: λ of the returns.
        entropy_scale: Weight of the actor's entropy.
        return_decay: Decay of the return percentiles.
        min_std: Smallest standard deviation of actions. The reference has 0.1; more keeps the actor exploring where a
            first way of doing something has made it sure of itself.
        max_std: Largest standard deviation of actions. The reference has 1.
        dynamics_scale: Weight of the dynamics loss.
        representation_scale: Weight of the representation loss.
        free_nats: KL below which there is no gradient, nats.
        kl_mode: Whether the free nats apply to the sum over latents (``separate``) or to each (``per_latent``).
        image_scale: Weight of the images' reconstruction: losses ``reconstruction`` and ``informed``. The reference has
            1.
        image_share: Share of a window's records, at least one, whose images are decoded, drawn anew in every update;
            the reference decodes all. Less makes an update cheaper.
        privileged_scale: Weight of decoding the privileged state: losses ``informed`` and ``privileged``.
        barlow_scale: Weight of the redundancy reduction: loss ``decoder_free``.
        drift_scale: Weight of the policy's drift, ``ActorLoss.hold``, where a replay keeps latents that are not drawn
            (``replay.context=true``, ``model.sampled=false``); 0 turns it off.
        continuation: Whether predicted ends of episodes cut imagined returns.
        slow_critic_scale: Weight of the regularisation towards the slow critic.
        replay_value_scale: Weight of the critic's loss on replayed returns; 0 turns it off.
        replay_value_gradient: Whether that loss also trains the world model's representation, as in the reference.
        ppo: Numbers of ``actor=ppo``, ``flown_ppo``, ``latent_ppo`` and ``asymmetric_ppo``.

    Reference: danijar/dreamerv3, ``configs.yaml``.
    """

    world_model: str = "reconstruction"
    actor: str = "reinforce"
    critic: str = "two_hot"
    discount: float = setting(0.997, SHARE)
    lambda_: float = setting(0.95, SHARE)
    entropy_scale: float = setting(3e-4, NOT_NEGATIVE)
    return_decay: float = setting(0.99, SHARE)
    min_std: float = setting(MIN_STD, POSITIVE_SHARE)
    max_std: float = setting(MAX_STD, POSITIVE_SHARE)
    dynamics_scale: float = setting(1.0, NOT_NEGATIVE)
    representation_scale: float = setting(0.1, NOT_NEGATIVE)
    free_nats: float = setting(1.0, NOT_NEGATIVE)
    kl_mode: str = "separate"
    image_scale: float = setting(1.0, NOT_NEGATIVE)
    image_share: float = setting(1.0, POSITIVE_SHARE)
    privileged_scale: float = setting(1.0, NOT_NEGATIVE)
    barlow_scale: float = setting(0.05, NOT_NEGATIVE)
    drift_scale: float = setting(0.0, NOT_NEGATIVE)
    continuation: bool = True
    slow_critic_scale: float = setting(1.0, NOT_NEGATIVE)
    replay_value_scale: float = setting(0.3, NOT_NEGATIVE)
    replay_value_gradient: bool = True
    ppo: ActorPPOConfig = field(default_factory=ActorPPOConfig)
