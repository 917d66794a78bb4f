"""Latent overshooting, a user-defined target of the world model, see docs/losses.md, "A larger target".

    export PYTHONPATH=examples/losses
    ./dev python recipes/dreamer_v3.py track=circle loss.world_model=privileged+overshooting:Overshooting

From each record it predicts three steps without observations, from the actions taken, and compares the prior with the
posterior there. Columns: loss_overshooting, overshooting_kl.
"""

import torch

from dreamer_racing.losses import Target, kl_losses


class Overshooting(Target):
    """KL loss between prior and posterior after open-loop steps. Reference: PlaNet (Hafner et al. 2019), Eq. 7."""

    steps, scale = 3, 0.3  # open-loop steps; weight of the loss

    def forward(self, posterior, features, embedding, batch):
        """Return the loss and the KL, scalars; shapes as in `Target.forward`."""
        rssm, count = self.world_model.rssm, features.shape[1] - self.steps
        ahead = [slice(step, count + step) for step in range(1, self.steps + 1)]
        # Every record but the last few is a start: (B, T, ...) -> (B * count, ...)
        belief, state = (latent[:, :count].flatten(0, 1) for latent in (posterior.belief, posterior.state))
        for records in ahead:
            action = batch["previous_action"][:, records].flatten(0, 1)
            belief, state = rssm.imagine_step(belief, state, action)  # one step by the prior, no image
        prior = rssm.prior_logits(belief).unflatten(0, (-1, count))
        target = posterior.posterior_logits[:, self.steps :]
        # The first KL loss trains only the prior, here through the dynamics that led to it
        loss, _, kl = kl_losses(target, prior, self.config.free_nats, rssm.unimix)
        # Predictions across the start of an episode are masked
        crossed = torch.stack([batch["is_init"][:, records, 0] for records in ahead]).any(0)
        same_episode = (~crossed).float()
        return {
            "loss_overshooting": self.scale * (same_episode * loss).mean(),
            "overshooting_kl": (same_episode * kl).sum() / same_episode.sum().clamp_min(1.0),
        }
