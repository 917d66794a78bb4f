"""Evaluations by protocol, and flights by hand."""

from __future__ import annotations

import dataclasses
import importlib.util
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation import by_hand, protocol
from dreamer_racing.evaluation.course import Course, act
from dreamer_racing.evaluation.evaluate import CRASHES, evaluate
from dreamer_racing.evaluation.image_corruptions import CorruptedPolicy, intact
from dreamer_racing.figures.protocol import mean_bar, plot_conditions, plot_crashes, share_bar
from dreamer_racing.machine import command_line, git_commit, provenance

WORLDS = {"track": "circle", "from_pixels": False, "num_threads": 1}


class Falling(torch.nn.Module):
    """Cuts the motors when deterministic; sideways otherwise."""

    deterministic = True

    def __init__(self) -> None:
        super().__init__()
        self.where = torch.nn.Parameter(torch.zeros(()))

    def make_primer(self) -> TensorDictPrimer:
        return TensorDictPrimer({"memory": Unbounded(shape=(1,))}, default_value=0.0, expand_specs=True)

    def forward(self, tensordict):
        action = torch.zeros(*tensordict.batch_size, 4, device=self.where.device)
        action[:, 0] = -1.0 if self.deterministic else 1.0
        return tensordict.set("action", action).set(("next", "memory"), tensordict["memory"])


def test_a_policy_hands_its_action_back_to_where_the_worlds_are():
    on_meta = TensorDict({"memory": torch.zeros(2, 1)}, [2], device="meta")
    assert act(Falling().to("meta"), on_meta)["action"].device.type == "meta"
    assert act(Falling(), TensorDict({"memory": torch.zeros(2, 1)}, [2]))["action"].device.type == "cpu"


class Noisy(Falling):
    """Draws its action when it is not deterministic."""

    def forward(self, tensordict):
        super().forward(tensordict)
        return tensordict.set("action", tensordict["action"] - torch.rand(*tensordict.batch_size, 4))


def test_samples_of_the_policy_are_by_the_seed_and_belong_to_the_evaluation():
    course = Course(Noisy(), {"track": "circle", "from_pixels": False, "start_noise": 1.0, "episode_steps": 40}, 3)
    first = course.evaluate(deterministic=False).episodes
    torch.manual_seed(5)
    before = torch.get_rng_state()
    torch.rand(7)
    moved = torch.get_rng_state()
    assert course.evaluate(deterministic=False).episodes == first
    assert torch.equal(torch.get_rng_state(), moved) and not torch.equal(before, moved)
    course.close()


def by_name(name: str) -> protocol.Condition:
    return next(condition for condition in protocol.CONDITIONS if condition.name == name)


def test_the_conditions_of_the_protocol_and_its_displaced_tracks():
    names = ["nominal", "start_noise", "camera_tilt", "gate_displacement"]
    assert [condition.name for condition in protocol.CONDITIONS] == names
    (nominal,) = by_name("nominal").races(load_track("circle"), seed=3)
    assert nominal == {"track": load_track("circle"), "start_noise": 0.0, "looks": None, "seed": 3}
    condition, track = by_name("gate_displacement"), load_track("circle")
    races = [race["track"] for race in condition.races(track, seed=0)]
    assert len(races) == condition.num_tracks == len({race.gates for race in races})
    assert races == [race["track"] for race in condition.races(track, seed=0)]


def test_camera_tilt_varies_and_no_other_look_does():
    (race,) = by_name("camera_tilt").races(load_track("circle"), seed=0)
    env = DroneRacingEnv(num_envs=100, evaluation=True, num_threads=1, renderer="warp", **race)
    env.reset()
    looks = env.worlds.simulator.looks.looks
    tilt = looks.camera_tilt
    assert 20.0 <= tilt.min() < 20.6 and 29.4 < tilt.max() <= 30.0
    assert (looks.field_of_view == 90.0).all() and (looks.colors == looks.colors[0]).all()
    env.close()


def test_every_condition_is_flown_by_both_policies():
    displaced = dataclasses.replace(by_name("gate_displacement"), num_tracks=3)
    conditions = (by_name("nominal"), by_name("camera_tilt"), displaced)
    results = list(protocol.run_protocol(Falling(), WORLDS, episodes=5, conditions=conditions, num_envs=5))
    flown = [(result.preset, result.condition, result.mode) for result in results]
    blind = ("nominal", "gate_displacement")  # there is no camera here
    assert flown == [(preset, name, mode) for preset in protocol.PRESETS for name in blind for mode in protocol.MODES]
    for result in results:
        record = result.to_dict()
        assert "episodes" not in record and record["num_episodes"] == len(result.evaluation.episodes) == 5
        outcome = "ground" if result.mode == "deterministic" else "out_of_bounds"
        assert record["crashes"] == dict.fromkeys(CRASHES, 0) | {outcome: 5}
        assert record["crashes_by_gate"][outcome] == [5, 0, 0, 0]


def test_an_agent_is_evaluated_with_its_own_physics_too():
    own = WORLDS | {"preset": "betaflight"}
    results = protocol.run_protocol(Falling(), own, episodes=1, conditions=[by_name("nominal")], num_envs=1)
    assert [result.preset for result in results] == ["easy"] * 2 + ["faithful"] * 2 + ["betaflight"] * 2


def test_both_policies_meet_the_same_starts():
    (race,) = by_name("start_noise").races(load_track("circle"), seed=1)
    first, second = (
        protocol.fly(Falling(), WORLDS | race, 5, deterministic, num_trajectories=5) for deterministic in (True, False)
    )
    starts, again = (torch.stack([one.position[0] for one in flown.trajectories]) for flown in (first, second))
    assert torch.equal(starts, again) and starts.std(0).min() > 0.1


def test_table_and_plots(tmp_path, figures):
    results = list(protocol.run_protocol(Falling(), WORLDS, episodes=2, conditions=protocol.CONDITIONS[:1], num_envs=2))
    table = protocol.results_table(results).splitlines()
    assert table[0].startswith("| physics | condition | policy | success | gates | best lap (s) ")
    assert len(table) == 2 + 4 and table[2].startswith("| easy | nominal | deterministic | 0% | 0.00 | – | – |")
    assert protocol.crashes_in_words(results[0].evaluation) == "ground: 2 at gate 1"
    assert protocol.results_table(results, "images").splitlines()[0].startswith("| physics | images |")
    plot_conditions(results, tmp_path / "conditions.png", "title")
    plot_crashes({"a": results[0].evaluation, "b": results[1].evaluation}, tmp_path / "new" / "crashes.png", "title")
    for path in (tmp_path / "conditions.png", tmp_path / "new" / "crashes.png"):
        with Image.open(path) as image:
            assert image.width == 1350
    success, gates = figures[0].axes
    for axes, words in ((success, "0%"), (gates, "0.00")):
        assert axes.get_ylim()[0] == 0.0  # nobody finished, no gate was passed
        # Where no physics are drawn at random, both episodes are the same flight.
        assert [note.get_text() for note in axes.texts] == [f"{words}\nn = {n}" for n in (1, 2, 1, 2)]
    assert all(axes.get_ylim()[0] == 0.0 for axes in figures[1].axes)


def test_conditions_that_a_track_has_no_room_for_are_refused_before_any_is_flown():
    circle = load_track("circle")
    protocol.check_protocol(protocol.CONDITIONS, circle, 0, "easy", 50.0)
    gate = circle.gates[0]
    near = tuple(a - 1.2 * b for a, b in zip(gate.position, gate.forward, strict=True))
    crowded = dataclasses.replace(circle, start_position=near)
    with pytest.raises(ValueError, match=r"cannot be flown with preset=easy: control_rate=200\.0 Hz"):
        protocol.check_protocol(protocol.CONDITIONS, circle, 0, "betaflight", 200.0)
    with pytest.raises(ValueError, match=r"condition start_noise cannot be flown on circle: start_noise=2"):
        protocol.check_protocol(protocol.CONDITIONS, crowded, 0, "easy", 50.0)


def test_intervals_of_bars():
    bar = share_bar([True] * 8 + [False] * 2)  # Wilson's, by hand: (8 + 1.92) / (10 + 3.84) ± 0.2267
    np.testing.assert_allclose(bar, (0.8, 0.4902, 0.9433, 10), atol=1e-4)
    never = share_bar([False] * 60)
    assert never.low == never.height == 0.0 and never.high == pytest.approx(0.0602, abs=1e-4)
    mean = mean_bar([1.0, 3.0, 5.0, 7.0])
    half = 1.96 * np.sqrt(20 / 3) / 2
    np.testing.assert_allclose(mean, (4.0, 4 - half, 4 + half, 4))
    assert mean_bar([5.0]) == (5.0, 5.0, 5.0, 1) and mean_bar([0.0, 1.0, 0.0]).low == 0.0


def test_a_policy_with_corrupted_images_is_flown_like_any_other():
    worlds = {"track": "circle", "num_threads": 1, "renderer": "warp", "episode_steps": 5}
    result = protocol.fly(CorruptedPolicy(Falling(), intact), worlds, 1, deterministic=True)
    assert result.episodes[0].length == 5


def test_provenance(tmp_path, monkeypatch):
    facts = provenance()
    assert {"machine", "gpu", "python", "torch", "torchrl", "mujoco", "commit"} <= set(facts)
    assert git_commit(tmp_path) is None  # no repository
    author = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], [*author, "commit", "-q", "--allow-empty", "-m", "a"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    assert git_commit(tmp_path) is None  # another's repository: nothing here is in it
    (tmp_path / "file").write_text("text")
    subprocess.run(["git", "add", "file"], cwd=tmp_path, check=True)
    assert git_commit(tmp_path).endswith("-dirty")
    monkeypatch.setattr("sys.argv", ["recipes/evaluate.py", "run_dir=a b"])
    assert command_line() == "python recipes/evaluate.py 'run_dir=a b'"
    monkeypatch.setenv("PATH", str(tmp_path))  # no git
    assert git_commit(tmp_path) is None


# Flying by hand: what sticks ask for is what the drone is told, with or without a window.


IMAGE = np.zeros((8, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("sticks", "action"),
    [
        (by_hand.StickPositions(roll=0.5, pitch=1.0, yaw=0.25), (-0.4, 0.5, 1.0, -0.25)),  # yaw right is −z
        (by_hand.StickPositions(throttle=1.0), (1.0, 0, 0, 0)),
        (by_hand.StickPositions(throttle=-1.0), (-1.0, 0, 0, 0)),
        (by_hand.StickPositions(throttle=0.5), (0.3, 0, 0, 0)),  # half of the way from hovering to all
    ],
)
def test_sticks_are_actions(sticks, action):
    policy, seen = by_hand.HandPolicy(lambda image: sticks, -0.4), TensorDict({"pixels": torch.zeros(1, 8, 8, 3)}, [1])
    torch.testing.assert_close(policy(seen)["action"], torch.tensor([action], dtype=torch.float32))


def test_keys_move_the_sticks_little_by_little_and_let_them_go():
    at = by_hand.StickPositions()
    for _ in range(30):
        at = by_hand.keys_to_sticks({"right": True, "down": True, "a": True, "w": True}, at)
    held = by_hand.KEYBOARD_SHARE
    assert at == pytest.approx((held, -held, -held, held), rel=1e-3)
    assert 0 < by_hand.keys_to_sticks({}, at).roll < at.roll
    assert by_hand.keys_to_sticks({"left": True, "right": True}, by_hand.StickPositions()) == by_hand.StickPositions()


def test_a_gamepad_counts_forward_as_negative_and_trembles():
    assert by_hand.axes_to_sticks({"roll": 0.5, "pitch": -1.0, "yaw": 0.01, "throttle": -0.25}) == (0.5, 1.0, 0.0, 0.25)


def test_a_script_flies_and_is_recorded_without_a_display():
    """Full throttle out of the hall: the camera's images arrive, and the flight is an episode like any other."""
    shown = []
    env = DroneRacingEnv("circle", 1, evaluation=True, renderer="warp", num_threads=1)

    def up(image: np.ndarray) -> by_hand.StickPositions:
        shown.append(image)
        return by_hand.StickPositions(throttle=1.0)

    result = evaluate(env, by_hand.HandPolicy(up, env.worlds.parameters.hover_action), episodes=1)
    env.close()
    (flight,) = result.trajectories
    assert len(shown) == len(flight.action) > 5 and shown[0].shape == (64, 64, 3)
    assert flight.outcome == "out_of_bounds" and flight.position[-1, 2] > flight.position[0, 2] + 1.0
    assert (flight.action == torch.tensor([1.0, 0, 0, 0])).all()


def test_without_pygame_or_display_it_says_so(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match="pilot=keyboard needs a display"):
        by_hand.check_by_hand("keyboard", {})
    by_hand.check_by_hand("keyboard", {"DISPLAY": ":0"})
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pilot=gamepad needs the package pygame: .*pip install .*play"):
        by_hand.check_by_hand("gamepad", {"DISPLAY": ":0"})


def test_a_window_shows_keeps_time_and_can_be_closed(monkeypatch):
    pygame = pytest.importorskip("pygame", reason="pip install 'dreamer_racing[play]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.raises(ValueError, match="there is no gamepad"):
        by_hand.PygameSticks("gamepad", 0.02)
    sticks = by_hand.PygameSticks("keyboard", control_dt=0.02)
    assert pygame.mixer.get_init() is None, "no sound, which many machines cannot play"
    assert sticks(IMAGE + 255) == by_hand.StickPositions()
    assert pygame.display.get_surface().get_at((3, 3))[:3] == (255, 255, 255)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
    with pytest.raises(by_hand.FlightAbandonedError):
        sticks(IMAGE)
    sticks.close()
