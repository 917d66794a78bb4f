"""The schedule of b₂ and the relabelling of sampled rewards."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, BodyRateSchedule, RelabelReward
from dreamer_racing.experience.replay import make_replay


def test_starts_at_zero_and_waits_for_a_full_window():
    curriculum = BodyRateCurriculum()
    assert curriculum.body_rate_weight == 0
    assert curriculum.update([60.0] * 99) == 0
    assert curriculum.update([60.0]) == 0.001


def test_threshold_is_exclusive():
    curriculum = BodyRateCurriculum(BodyRateSchedule(window=2, cooldown=1))
    assert curriculum.update([50.0, 50.0]) == 0
    assert curriculum.update([50.1]) == 0.001


def test_cooldown_cap_and_no_decrease():
    curriculum = BodyRateCurriculum()
    weights = [curriculum.update([60.0]) for _ in range(2000)]
    grown = [episode + 1 for episode in range(1, 2000) if weights[episode] > weights[episode - 1]]
    assert grown == list(range(100, 1001, 100))
    assert weights[-1] == 0.01
    assert curriculum.update([-100.0] * 500) == 0.01


def test_window_forgets():
    curriculum = BodyRateCurriculum(BodyRateSchedule(window=3, cooldown=1))
    assert curriculum.update([0.0, 0.0, 0.0, 100.0]) == 0  # mean 33
    assert curriculum.update([100.0]) == 0.001  # mean 67


def test_one_call_equals_many_and_takes_tensors():
    returns = torch.randn(3000, generator=torch.Generator().manual_seed(0)) * 30 + 50
    one, many = BodyRateCurriculum(BodyRateSchedule(maximum=1.0)), BodyRateCurriculum(BodyRateSchedule(maximum=1.0))
    for chunk in returns.split(37):
        many.update(chunk)
    assert one.update(returns) == many.body_rate_weight == pytest.approx(one.update([]))
    assert 0 < one.body_rate_weight < 0.029  # otherwise this compares nothing


def test_state_continues_exactly():
    returns = torch.randn(1000, generator=torch.Generator().manual_seed(1)) * 10 + 51
    whole, before, after = BodyRateCurriculum(), BodyRateCurriculum(), BodyRateCurriculum()
    before.update(returns[:450])
    after.load_state_dict(before.state_dict())
    expected = [whole.update([value]) for value in returns.tolist()]
    assert [after.update([value]) for value in returns[450:].tolist()] == expected[450:]
    assert expected[449] < expected[-1]


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="window=0"):
        BodyRateCurriculum(BodyRateSchedule(window=0))


def rollout(num_envs: int, steps: int, weight: float) -> TensorDict:
    batch = (num_envs, steps)
    flag = torch.zeros(*batch, 1, dtype=torch.bool)
    begins = flag.clone()
    begins[:, 0] = True
    base, norm = torch.randn(*batch, 1), torch.rand(*batch, 1) * 10
    pixels = torch.zeros(*batch, 2, 2, 2, dtype=torch.uint8)
    arrived = {"pixels": pixels, "reward": base - weight * norm, "reward_base": base, "body_rate_norm": norm}
    root = {"pixels": pixels, "action": torch.zeros(*batch, 4), "is_init": begins}
    return TensorDict({**root, "next": {**arrived, "terminated": flag, "truncated": flag}}, batch)


def test_samples_carry_todays_reward():
    curriculum = BodyRateCurriculum(BodyRateSchedule(window=1, cooldown=1))
    relabelled = make_replay(100, 2, 8, 5, transform=RelabelReward(curriculum))
    stored = make_replay(100, 2, 8, 5)
    data = rollout(2, 20, weight=0.0)
    relabelled.extend(data)
    stored.extend(data)
    for _ in range(3):
        weight = curriculum.update([60.0])
        new, old = relabelled.sample(), stored.sample()
        # What the environment would pay for the same steps today.
        assert torch.equal(new["reward"], new["reward_base"] - weight * new["body_rate_norm"])
        assert torch.equal(old["reward"], new["reward_base"])
        assert (new["reward"] != old["reward"])[~new["is_init"]].all()
        assert not new["reward"][new["is_init"]].any()
    assert torch.equal(relabelled.records(0)["reward"], stored.records(0)["reward"])  # the storage is left alone


def test_relabelling_agrees_with_the_environment_at_the_same_weight():
    curriculum = BodyRateCurriculum(BodyRateSchedule(window=1, cooldown=1))
    weight = curriculum.update([60.0] * 4)
    replay = make_replay(100, 2, 8, 5, transform=RelabelReward(curriculum))
    data = rollout(2, 20, weight=weight)
    replay.extend(data)
    sample = replay.sample()
    slot = sample["index"][~sample["is_init"].squeeze(-1)]
    collected = data["next", "reward"][slot // 50, slot % 50 - 1]
    assert torch.allclose(sample["reward"][~sample["is_init"].squeeze(-1)], collected, atol=1e-6)
