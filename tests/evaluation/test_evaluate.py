"""Evaluation: whole episodes only, as many as asked for, and numbers that add up."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, TransformedEnv

from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.evaluate import CRASHES, FINISHED, TIMEOUT, Evaluation, evaluate

DT = 0.02


class ScriptedRace(EnvBase):
    """Environment i's k-th episode lasts script[i][k][0] steps and ends as script[i][k][1]; the last one repeats.

    Every step has the reward 1 and speed `length` of its episode, except that the drone of a crash ends with an
    infinite speed; every second step passes a gate at offset 0.1 · i, and every fourth completes a lap of length · DT.
    The gates are three.
    """

    def __init__(self, script: list[list[tuple[int, str]]]) -> None:
        super().__init__(batch_size=[len(script)])
        self.script = script
        parameters, track = SimpleNamespace(control_dt=DT), SimpleNamespace(num_gates=3)
        camera = SimpleNamespace(tilt=30.0)
        effort = torch.tensor([[0.25, 8.0, 2.0]]).repeat(len(script), 1)
        self.worlds = SimpleNamespace(evaluation=True, parameters=parameters, track=track, camera=camera, effort=effort)
        n = self.batch_size
        self.action_spec = Bounded(-1.0, 1.0, (*n, 4))
        self.reward_spec = Unbounded((*n, 1))
        self.done_spec = Composite({key: Binary(1, (*n, 1), dtype=torch.bool) for key in DONE}, shape=n)
        race = {name: Unbounded((*n, 1)) for name in ("crash", "finished", "gates_passed", "gate_offset", "lap_time")}
        privileged = {name: Unbounded((*n, size)) for name, size in STATE.items()}
        self.observation_spec = Composite(
            race=Composite(race, shape=n),
            privileged=Composite(privileged, shape=n),
            pixels=Unbounded((*n, 2, 2, 3), dtype=torch.uint8),
            shape=n,
        )
        self.number = torch.full(n, -1)
        self.age = torch.zeros(n, dtype=torch.int64)

    def _set_seed(self, seed: int | None) -> None: ...

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.view(self.batch_size)
        self.number, self.age = self.number + mask, self.age.masked_fill(mask, 0)
        data = self.observation_spec.zero()
        data["privileged", "position"][:] = self.number.view(-1, 1)
        return data

    def _step(self, tensordict):
        self.age += 1
        data = self.observation_spec.zero()
        data["reward"] = torch.ones(*self.batch_size, 1)
        data.update({key: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for key in DONE})
        for i, episodes in enumerate(self.script):
            length, outcome = episodes[min(int(self.number[i]), len(episodes) - 1)]
            age = int(self.age[i])
            ends, crashes = age == length, age == length and outcome in CRASHES
            data["done"][i] = ends
            data["terminated" if crashes else "truncated"][i] = ends
            data["race", "crash"][i] = CrashCause[outcome.upper()] if crashes else 0
            data["race", "finished"][i] = ends and outcome == FINISHED
            data["race", "gates_passed"][i] = age // 2
            data["privileged", "target_gate"][i] = age // 2 % 3
            data["race", "gate_offset"][i] = 0.1 * i * (age % 2 == 0)
            data["race", "lap_time"][i] = length * DT * (age % 4 == 0)
            data["privileged", "position"][i] = self.number[i]
            data["privileged", "linear_velocity"][i, 0] = float("inf") if crashes else length
            data["pixels"][i] = age
        return data


DONE = ("done", "terminated", "truncated")
STATE = {"position": 3, "attitude": 4, "linear_velocity": 3, "body_rates": 3, "target_gate": 1}
SCRIPT = [[(2, "ground"), (9, FINISHED)], [(30, TIMEOUT)], [(4, "gate_frame"), (6, FINISHED), (1, "ground")]]


def acting(act: Callable[[torch.Tensor], torch.Tensor]) -> TensorDictModule:
    """A policy that makes actions (N, 4) of positions (N, 3)."""
    return TensorDictModule(act, [("privileged", "position")], ["action"])


def fly_idly(episodes: int, script: list[list[tuple[int, str]]] | None = None, **options) -> Evaluation:
    """Evaluate a policy that does nothing in a scripted race."""
    env = ScriptedRace(script or SCRIPT)
    return evaluate(env, acting(lambda position: torch.zeros(len(position), 4)), episodes, **options)


def hover(env: DroneRacingEnv, falling: Sequence[int] = ()) -> TensorDictModule:
    """Hover, but in some environments without thrust."""
    action = torch.zeros(*env.batch_size, 4)
    action[:, 0] = env.worlds.parameters.hover_action
    for index in falling:
        action[index, 0] = -1.0
    return acting(lambda position: action.clone())


def race(num_envs: int, **arguments) -> DroneRacingEnv:
    arguments = {"evaluation": True, "episode_steps": 60, "from_pixels": False, "num_threads": 1} | arguments
    return DroneRacingEnv("circle", num_envs, seed=0, **arguments)


@pytest.mark.parametrize(("episodes", "lengths"), [(1, [2]), (5, [2, 30, 4, 9, 30]), (7, [2, 30, 4, 9, 30, 6, 9])])
def test_flies_the_episodes_dealt_to_each_environment_however_long_they_last(episodes, lengths):
    result = fly_idly(episodes)
    assert [episode.length for episode in result.episodes] == lengths
    assert [episode.reward_sum for episode in result.episodes] == lengths  # 1 a step: none of a neighbour's
    assert all(episode.speed_mean == episode.length for episode in result.episodes if episode.outcome not in CRASHES)


def test_says_how_many_episodes_have_ended():
    told = []
    script = [[(2, "ground"), (3, "ground")], [(2, "ground"), (1, "ground")]]
    fly_idly(3, script, on_episode=lambda *numbers: told.append(numbers))
    assert told == [(2, 3), (3, 3)]  # both worlds' first together


def test_statistics_by_hand():
    result = fly_idly(5)
    assert [episode.outcome for episode in result.episodes] == ["ground", TIMEOUT, "gate_frame", FINISHED, TIMEOUT]
    assert result.success_rate == pytest.approx(1 / 5)
    assert result.timeout_rate == pytest.approx(2 / 5)
    assert result.crashes == dict.fromkeys(CRASHES, 0) | {"ground": 1, "gate_frame": 1}
    assert result.gates_per_episode == pytest.approx((1 + 15 + 2 + 4 + 15) / 5)
    assert result.episode_length == result.return_mean == pytest.approx(75 / 5)
    assert result.return_std == pytest.approx(torch.tensor([2.0, 30, 4, 9, 30]).std(correction=0).item())
    assert result.lap_time_best == pytest.approx(4 * DT)
    assert result.lap_time_mean == pytest.approx((4 + 2 * 9 + 14 * 30) * DT / 17)
    assert result.speed_max == 30  # the infinite speeds of the crashes count as none
    assert result.speed_mean == pytest.approx((2 * 2 + 4 * 4 + 9 * 9 + 2 * 30 * 30) / 75)
    offsets = [0.0] * 1 + [0.1] * 15 + [0.2] * 2 + [0.0] * 4 + [0.1] * 15  # a pass through the very centre counts
    assert result.gate_offset_mean == pytest.approx(sum(offsets) / len(offsets))
    assert [episode.saturation_share for episode in result.episodes] == [0.25] * 5
    assert (result.saturation_share, result.thrust_shortfall) == pytest.approx((0.25, 0.25))


def test_crashes_by_gate():
    """Environment 0 crashes after one gate, 1 after seven (2 laps and 1), 2 before any; 3 finishes."""
    script = [[(2, "ground")], [(14, "ground")], [(1, "gate_frame")], [(9, FINISHED)]]
    result = fly_idly(8, script)
    assert [episode.crash_gate for episode in result.episodes] == [1, 1, 0, None] * 2
    none = {cause: [0, 0, 0] for cause in CRASHES}
    assert result.crashes_by_gate == none | {"ground": [0, 4, 0], "gate_frame": [2, 0, 0]}


def test_a_hover_is_within_the_motors_limits_and_full_roll_at_full_thrust_is_not():
    for preset in ("easy", "betaflight"):
        env = race(1, preset=preset, episode_steps=20)
        calm = evaluate(env, hover(env), 1)
        assert (calm.saturation_share, calm.thrust_shortfall) == pytest.approx((0.0, 0.0), abs=2e-3)  # a µs of throttle
        rolled = evaluate(env, acting(lambda position: torch.tensor([[1.0, 1.0, 0.0, 0.0]])), 1)
        assert rolled.saturation_share > 0.2 and rolled.thrust_shortfall > 0.02


def test_action_change_by_hand():
    """Steps of ‖(0.3, 0.4, 0, 0)‖ = 0.5 up and down; beyond [−1, 1] nothing changes; episodes do not touch."""
    actions = {0: (0.0, 0.3, 0.0), 1: (1.0, 3.0, 1.0, -1.0)}  # of each environment, step by step
    scale = torch.tensor([[1.0, 4 / 3, 0, 0], [1.0, 0, 0, 0]])
    steps = iter(range(100))

    def act(position):
        step = next(steps)
        rows = [torch.full((4,), actions[index][step % len(actions[index])]) for index in range(2)]
        return torch.stack(rows) * scale

    result = evaluate(ScriptedRace([[(3, TIMEOUT)], [(4, TIMEOUT)]]), acting(act), 4)
    assert [episode.action_change_mean for episode in result.episodes] == pytest.approx([0.5, 2 / 3, 0.5, 2 / 3])
    assert result.action_change_mean == pytest.approx((4 * 0.5 + 6 * 2 / 3) / 10)


def test_an_action_that_is_not_finite_counts_as_zero_and_one_step_has_no_change():
    lost = acting(lambda position: torch.full((1, 4), float("nan")))
    for steps, episodes in ((2, 1), (1, 2)):
        assert evaluate(ScriptedRace([[(steps, "invalid_action")]]), lost, episodes).action_change_mean == 0.0


def test_joined_evaluations_have_all_episodes():
    joined = Evaluation.join([fly_idly(2), fly_idly(3)])
    assert [episode.length for episode in joined.episodes] == [2, 30, 2, 30, 4]
    assert joined.num_gates == 3 and len(joined.trajectories) == 2


def test_json_has_the_promised_keys_and_nothing_that_is_not_json():
    read = json.loads(fly_idly(4).to_json(), parse_constant=pytest.fail)
    promised = {"success_rate", "gates_per_episode", "lap_time_best", "lap_time_mean", "speed_max"}
    assert promised | {"gate_offset_mean", "crashes"} <= set(read)
    assert read["num_episodes"] == len(read["episodes"]) == 4
    assert sum(read["crashes"].values()) == sum(episode["outcome"] in CRASHES for episode in read["episodes"])


def test_no_lap_and_no_pass_are_none():
    result = fly_idly(2, [[(1, "ground")]])
    assert (result.lap_time_best, result.lap_time_mean, result.gate_offset_mean) == (None, None, None)
    assert "best –" in result.summary() and "2 ground" in result.summary()


def test_records_the_first_episode_only():
    crashed, late = fly_idly(6, num_trajectories=2).trajectories
    assert (crashed.outcome, crashed.crashed, late.outcome, late.crashed) == ("ground", True, TIMEOUT, False)
    assert [len(crashed.position), len(crashed.action), len(late.position), len(late.action)] == [3, 2, 31, 30]
    assert crashed.pixels[:, 0, 0, 0].tolist() == [0, 1, 2]
    assert late.pixels[:, 0, 0, 0].tolist() == list(range(31))
    assert (crashed.position == 0).all()
    assert late.speed.tolist() == [0.0] + [30.0] * 30
    assert crashed.part(0, 2).outcome == "ground"
    part = crashed.part(1, 1)
    assert (len(part.position), len(part.action), part.pixels[0, 0, 0, 0], part.outcome) == (1, 0, 1, None)
    blind = fly_idly(3, num_trajectories=3, record_pixels=False).trajectories
    assert [(len(flight.position), flight.pixels) for flight in blind] == [(3, None), (31, None), (5, None)]
    assert fly_idly(3, num_trajectories=0).trajectories == []


def test_what_a_critic_makes_of_each_state_is_recorded_beside_the_action():
    """It sees what the policy has acted on, of the recorded worlds only, and no more than is recorded."""
    asked = []

    def value(acted):
        asked.append(len(acted["action"]))
        return acted["pixels"][:, 0, 0, :1].float() * 10

    crashed, late = fly_idly(6, num_trajectories=2, value_function=value).trajectories
    assert crashed.value.tolist() == [0.0, 10.0]
    assert late.value.tolist() == [10.0 * step for step in range(30)]
    assert asked == [2] * 30
    assert crashed.part(1, 2).value.tolist() == [10.0]
    assert crashed.camera_tilt == 30.0
    assert fly_idly(1).trajectories[0].value is None


def test_recurrent_policy_starts_every_episode_afresh():
    """A policy that counts its steps in a primed key: the count that reaches the action restarts with the episode."""
    counts = []

    def count(steps, is_init):
        assert not torch.is_grad_enabled()
        steps = torch.where(is_init, 0.0, steps) + 1.0
        counts.append(steps.flatten().tolist())
        return torch.zeros(3, 4), steps

    policy = TensorDictModule(count, ["steps", "is_init"], ["action", ("next", "steps")])
    primer = TensorDictPrimer({"steps": Unbounded(shape=(1,))}, default_value=0.0, expand_specs=True)
    env = TransformedEnv(ScriptedRace(SCRIPT), Compose(InitTracker(), primer))
    result = evaluate(env, policy, 5)
    assert [episode.length for episode in result.episodes] == [2, 30, 4, 9, 30]
    assert [row[0] for row in counts[:11]] == [1, 2, *range(1, 10)]
    assert [row[1] for row in counts] == [*range(1, 31), *range(1, 31)]


def test_hover_runs_out_of_time_and_no_thrust_falls_as_recorded():
    env = race(3)
    result = evaluate(env, hover(env, falling=[1]), 7, num_trajectories=2)
    assert [episode.outcome for episode in result.episodes] == [TIMEOUT, "ground", TIMEOUT] * 2 + [TIMEOUT]
    assert result.success_rate == 0
    assert result.crashes["ground"] == 2
    assert result.gates_per_episode == 0
    # The rotors start at hover speed and lag by 33 ms; the fall from 1.35 m to 0.05 m lasts a bit over √(2 h / g).
    assert 0.51 < result.episodes[1].duration < 0.60
    assert result.episodes[0].length == 60
    assert result.episodes[0].speed_max < 0.01
    fall = result.trajectories[1]
    assert fall.position[0].tolist() == pytest.approx([4.0, -2.5, 1.35])
    assert fall.position[-1, 2] < 0.05 + 1e-6
    mean_velocity = (fall.linear_velocity[1:] + fall.linear_velocity[:-1]) / 2
    torch.testing.assert_close(fall.position.diff(dim=0), mean_velocity * DT, atol=2e-3, rtol=0)
    assert fall.pixels is None


@pytest.mark.parametrize(
    ("arguments", "episodes", "message"),
    [
        ({"evaluation": False}, 1, "evaluation=True"),
        ({"privileged": False}, 1, "privileged=True"),
        ({}, 0, "episodes=0"),
    ],
)
def test_refuses_what_it_cannot_measure(arguments, episodes, message):
    with pytest.raises(ValueError, match=message):
        evaluate(race(1, **arguments), lambda tensordict: pytest.fail("must not fly"), episodes)
