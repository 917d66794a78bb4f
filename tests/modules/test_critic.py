import torch

from dreamer_racing.modules.critic import Critic


def test_slow_copy_moves_by_the_rate_and_never_trains():
    critic = Critic(4, layers=1, units=8)
    fast, slow = critic.head.mlp.output.bias, critic.slow_head.mlp.output.bias
    with torch.no_grad():
        fast.fill_(1.0)
    assert torch.equal(slow, torch.zeros_like(slow))
    critic.update_slow(0.25)
    torch.testing.assert_close(slow, torch.full_like(slow, 0.25))
    critic.update_slow(0.25)
    torch.testing.assert_close(slow, torch.full_like(slow, 0.4375))
    assert not any(parameter.requires_grad for parameter in critic.slow_head.parameters())


def test_new_critic_expects_nothing():
    critic = Critic(4, layers=1, units=8)
    features = torch.randn(3, 5, 4)
    assert torch.equal(critic.value(features), torch.zeros(3, 5, 1))
    assert torch.equal(critic.slow_value(features), torch.zeros(3, 5, 1))
    assert not critic.slow_value(features).requires_grad
