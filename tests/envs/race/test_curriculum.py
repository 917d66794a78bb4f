"""Rewards, their curriculum, and the race vector."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, BodyRateSchedule, RelabelReward
from dreamer_racing.envs.race.race import RewardWeights, race_reward
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.experience.replay import make_replay


@pytest.mark.parametrize(
    ("schedule", "returns", "weights"),
    [
        (BodyRateSchedule(), [[60.0] * 99, [60.0]], [0, 0.001]),  # it waits for a full window
        (BodyRateSchedule(window=2, cooldown=1), [[50.0, 50.0], [50.1]], [0, 0.001]),  # the threshold is exclusive
        (BodyRateSchedule(window=3, cooldown=1), [[0.0, 0.0, 0.0, 100.0], [100.0]], [0, 0.001]),  # means of 33 and 67
    ],
)
def test_growth_by_hand(schedule, returns, weights):
    curriculum = BodyRateCurriculum(schedule)
    assert curriculum.body_rate_weight == 0
    assert [curriculum.update(chunk) for chunk in returns] == weights


def test_cooldown_cap_and_no_decrease():
    curriculum = BodyRateCurriculum()
    weights = [curriculum.update([60.0]) for _ in range(2000)]
    grown = [episode + 1 for episode in range(1, 2000) if weights[episode] > weights[episode - 1]]
    assert grown == list(range(100, 1001, 100))
    assert weights[-1] == 0.01
    assert curriculum.update([-100.0] * 500) == 0.01


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


def test_a_window_of_no_episodes_is_refused():
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


# Eq. 1 by hand.


GATE = torch.tensor([[10.0, 0.0, 0.0]])
RATES = torch.tensor([[1.0, 2.0, 2.0]])  # norm 3


ORIGIN, AHEAD = (0.0, 0.0, 0.0), (0.2, 0.0, 0.0)
BEFORE, BEYOND = (9.9, 0.0, 0.0), (10.1, 0.0, 0.0)
OTHERS = RewardWeights(progress=2.0, body_rate=0.5, gate=7.0, collision=-1.0)


@pytest.mark.parametrize(
    ("name", "weight"), [("progress", math.nan), ("body_rate", math.inf), ("gate", "10"), ("collision", True)]
)
def test_weights_are_finite_numbers(name, weight):
    with pytest.raises(ValueError, match=f"RewardWeights.{name}={weight!r}: must be (a number, )?finite"):
        RewardWeights(**{name: weight})


def test_defaults_are_the_papers():
    assert RewardWeights() == RewardWeights(progress=1.0, body_rate=0.0, gate=10.0, collision=-4.0)


@pytest.mark.parametrize(
    ("previous", "position", "given", "expected"),
    [
        # progress is the decrease of the distance
        (AHEAD, ORIGIN, {}, (pytest.approx(-0.2), pytest.approx(3.0))),
        ((10.0, 3.0, 4.0), (10.0, 0.0, 1.0), {}, (pytest.approx(4.0), pytest.approx(3.0))),  # from 5 m away to 1 m
        ((7.0, 4.0, 0.0), (7.0, -4.0, 0.0), {}, (pytest.approx(0.0), pytest.approx(3.0))),  # along a sphere
        # a pass replaces progress and the rate term
        (BEFORE, BEYOND, {"passes": 1}, (10.0, 0.0)),
        # a crash outweighs everything, and hides lost numbers
        (BEFORE, BEYOND, {"crashed": True}, (-4.0, 0.0)),
        (BEFORE, BEYOND, {"passes": 1, "crashed": True}, (-4.0, 0.0)),
        (ORIGIN, (math.nan, 0.0, math.inf), {"crashed": True, "rates": RATES * math.nan}, (-4.0, 0.0)),
        # the rate term is left to the caller, so b₂ changes neither part
        (ORIGIN, AHEAD, {"weights": OTHERS}, (pytest.approx(0.4), pytest.approx(3.0))),
        (ORIGIN, AHEAD, {"weights": OTHERS, "passes": 1}, (7.0, 0.0)),
        (ORIGIN, AHEAD, {"weights": OTHERS, "crashed": True}, (-1.0, 0.0)),
    ],
)
def test_one_step_is_rewarded(previous, position, given, expected):
    case = {"weights": RewardWeights(), "rates": RATES, "passes": 0, "crashed": False, **given}
    places, events = (torch.tensor([previous]), torch.tensor([position])), ("passes", "crashed")
    parts = race_reward(case["weights"], GATE, *places, case["rates"], *(torch.tensor([case[it]]) for it in events))
    assert tuple(part.item() for part in parts) == expected


def test_drones_are_independent():
    base, rate = race_reward(
        RewardWeights(),
        GATE.expand(3, 3),
        torch.zeros(3, 3),
        torch.tensor([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [math.nan, 0.0, 0.0]]),
        RATES.expand(3, 3),
        torch.tensor([False, True, False]),
        torch.tensor([False, False, True]),
    )
    assert base.tolist() == [1.0, 10.0, -4.0]
    assert rate.tolist() == [3.0, 0.0, 0.0]


@pytest.mark.parametrize("track", ["kidney", "figure8", "split_s", "circle"])
def test_a_race_vector_says_where_the_drone_is(track: str) -> None:
    worlds = RaceWorlds(track, num_envs=64, from_pixels=False, start_on_line=1.0)
    worlds.reset()
    for _ in range(10):
        worlds.step(torch.rand(64, 4) * 0.4 - 0.2)
    gate, state = worlds.race.target_gate, worlds.simulator.state
    position, attitude, misfit = worlds.race_vector.pose(worlds.vector(), gate)
    torch.testing.assert_close(position, state.position, atol=1e-4, rtol=0)
    same = (attitude * state.attitude).sum(-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), atol=1e-6, rtol=0)
    assert misfit.max() < 1e-8


def test_other_gates_fit_worse_than_those_that_were_seen() -> None:
    worlds = RaceWorlds("kidney", num_envs=64, from_pixels=False, start_on_line=1.0)
    worlds.reset()
    vector = worlds.vector() + 0.02 * torch.randn(64, 21)  # as a model that is not exact decodes it
    gate = worlds.race.target_gate
    misfits = [worlds.race_vector.pose(vector, (gate + offset) % worlds.track.num_gates)[2] for offset in (0, -1, 1)]
    assert (torch.stack(misfits).argmin(0) == 0).float().mean() > 0.9
    position = worlds.race_vector.pose(vector, gate)[0]
    assert (position - worlds.simulator.state.position).norm(dim=-1).median() < 0.5
