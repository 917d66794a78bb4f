"""Collection on Ray: arrays, the cluster, rollouts."""

from __future__ import annotations

import importlib.util
import os
import pickle
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.experience.ray_cluster import WorkersConfig as Share
from dreamer_racing.experience.ray_cluster import check_resources, check_versions, join, start_workers
from dreamer_racing.experience.ray_rollouts import RayRollouts, WorkerError
from dreamer_racing.experience.ray_worker import RayWorker, Request, as_arrays, pack_rollout, unpack_rollout
from dreamer_racing.experience.replay import make_replay
from dreamer_racing.modules import DreamerPolicy, Interface
from dreamer_racing.training.episodes import EpisodeTracker
from tests.dreamers import learner_of
from tests.ray_workers import small_race, worlds_of_worker


def sent(arrays: Any) -> Any:
    """Return what another process gets: arrays in memory that is not to be written."""
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(arrays, protocol=5, buffer_callback=buffers.append)
    assert len(buffers) == len(arrays.entries), "each in memory of its own, not within the pickle"
    return pickle.loads(data, buffers=[memoryview(buffer).toreadonly() for buffer in buffers])


def rollout_of(worlds: int, steps: int) -> TensorDict:
    """A rollout as a collector makes it: observed before a step is what came of the last, or an episode begins."""
    after, begins = TensorDict(_observed(worlds, steps), [worlds, steps]), torch.rand(worlds, steps, 1) > 0.6
    before = TensorDict(_observed(worlds, steps), [worlds, steps])
    before[:, 1:] = torch.where(begins[:, 1:, 0], before[:, 1:], after[:, :-1])
    after.update({"reward": torch.randn(worlds, steps, 1), "is_init": torch.zeros_like(begins)})
    return before.update({"action": torch.randn(worlds, steps, 4), "is_init": begins, "next": after})


def _observed(worlds: int, steps: int) -> dict[str, Any]:
    return {
        "pixels": torch.randint(256, (worlds, steps, 4, 4, 3), dtype=torch.uint8),
        "race": TensorDict({"crash": torch.randint(9, (worlds, steps))}, [worlds, steps]),
        "belief": torch.randn(worlds, 5, steps).transpose(1, 2).half(),  # not contiguous
    }


@pytest.mark.parametrize("steps", [1, 4])
def test_rollouts_of_several_workers_arrive_side_by_side(steps: int) -> None:
    rollouts = [rollout_of(worlds, steps) for worlds in (2, 3)]
    for given in (rollouts, rollouts[:1]):
        packed, expected = [sent(pack_rollout(rollout)) for rollout in given], torch.cat(given)
        arrived = unpack_rollout(*packed)
        assert arrived.batch_size == expected.batch_size and set(arrived.keys(True)) == set(expected.keys(True))
        for key, value in expected.items(True, True):
            assert arrived[key].dtype == value.dtype and torch.equal(arrived[key], value), key
        arrived.zero_()  # memory of its own


def test_each_observation_goes_once() -> None:
    """After its step; before it, too, where a rollout or an episode begins."""
    rollout = rollout_of(worlds=3, steps=4)
    begins = rollout["is_init"][..., 0].clone()
    begins[:, 0] = True
    packed = pack_rollout(rollout).entries
    for key in ("pixels", ("race", "crash"), "belief"):
        assert len(packed[key]) == begins.sum() < rollout.numel()
    assert packed["next", "pixels"].shape[:2] == packed["action"].shape[:2] == (3, 4)


# What is refused before workers begin, in plain words; no Ray is needed to know it.


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"Ray is not installed here.*\[ray\].*collector=local"):
        join("local")


@pytest.mark.parametrize("address", ["auto", "somewhere"])
def test_where_there_is_no_cluster_the_address_is_named(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray, the extra `ray`, is not installed")

    def refuse(**arguments: object) -> None:
        raise ConnectionError("Could not find any running Ray instance.\nPlease specify another.")

    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setattr("ray.init", refuse)
    words = rf"workers\.address={address}: cannot connect .*\(Could not find .* another\).*workers\.address=local"
    with pytest.raises(ValueError, match=words):
        join(address)


def test_where_nobody_answers_ray_does_not_try_for_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray, the extra `ray`, is not installed")
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as server:  # a port that is nobody's once it is closed
        address = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(ValueError, match=rf"workers\.address={address}: cannot connect .*refused"):
        join(address)


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (Share(1.0, 0.0), r"num_workers=4 with workers\.cpus=1 need 4 CPUs, and .* has 3, of which 2 are free"),
        (Share(0.5, 0.5), r"num_workers=4 with workers\.gpus=0\.5 need 2 GPUs, and .* has 0, of which 0 are free"),
    ],
)
def test_what_a_cluster_does_not_have_is_not_waited_for(share: Share, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        check_resources(4, share, [{"CPU": 2.0}, {"CPU": 1.0}], {"CPU": 2.0})
    check_resources(2, Share(1.0, 0.0), [{"CPU": 3.0}], {"CPU": 2.0})


@pytest.mark.parametrize(
    ("share", "nodes", "room"),
    [
        (Share(1.0, 0.6), [{"CPU": 16.0, "GPU": 2.0}], 2),  # one on each GPU
        (Share(2.0, 0.0), [{"CPU": 3.0}, {"CPU": 3.0}], 2),
        (Share(1.0, 2.0), [{"CPU": 9.0, "GPU": 3.0}, {"CPU": 9.0, "GPU": 3.0}], 2),
        (Share(0.1, 0.1), [{"CPU": 1.0, "GPU": 1.0}], 10),
    ],
)
def test_a_worker_is_not_spread_over_nodes_or_gpus(share: Share, nodes: list[dict[str, float]], room: int) -> None:
    free = {name: sum(node.get(name, 0.0) for node in nodes) + 9.0 for name in ("CPU", "GPU")}
    check_resources(room, share, nodes, free)
    with pytest.raises(ValueError, match=rf"the cluster's {len(nodes)} nodes have room for {room} workers"):
        check_resources(room + 1, share, nodes, free)


def test_nodes_of_other_versions_are_refused() -> None:
    here = {"python": "3.11.2", "torch": "2.13.0", "ray": "2.60.0"}
    check_versions("one", here, here)
    words = r"node two has torch 2\.12\.0 \(here 2\.13\.0\), ray None \(here 2\.60\.0\)\. Install the same versions"
    with pytest.raises(ValueError, match=words):
        check_versions("two", {"python": "3.11.2", "torch": "2.12.0"}, here)


# Collection by workers on a real Ray cluster, one of which is killed on the way.


N, W, T = 4, 2, 5
FRAMES = N * T  # of a round
SEED, ROUNDS, KILLED_AFTER = 3, 9, 4
INTERVAL = 3 * FRAMES
TAKEN_AT = [0, 0, 0, 2, 2, 4, 4, 6, 6]
"""Rounds learned from when the weights of each round were taken: at its end these are 3 rounds old at most."""
AGES_LATER = [2 * FRAMES, 3 * FRAMES, 2 * FRAMES]
"""Of the round under way in the end, and of two after it."""


class Flown(NamedTuple):
    """What came of it."""

    rounds: list[TensorDictBase]  # each [N, T]
    ages: list[int]
    processes: list[list[tuple[str, int]]]
    rollouts: RayRollouts
    drained: TensorDictBase | None
    ages_later: list[int]

    @property
    def lost_in(self) -> int:
        """The first round that worker 1's successor flew: the one under way at the kill, unless that was flown."""
        return next(number for number, now in enumerate(self.processes) if now[1] != self.processes[0][1])


def policy_of(env: DroneRacingEnv) -> DreamerPolicy:
    return learner_of("debug", Interface.of(env), seed=0).policy()


@torch.no_grad()
def learn(policy: DreamerPolicy, env: DroneRacingEnv) -> None:
    """Change the weights, and b₂."""
    for parameter in policy.parameters():
        parameter.add_(0.01)
    env.body_rate_weight += 0.001


def after(rounds: int, env: DroneRacingEnv) -> DreamerPolicy:
    """The policy after learning from so many rounds, and the environment too."""
    policy, env.body_rate_weight = policy_of(env), 0.0
    for _ in range(rounds):
        learn(policy, env)
    return policy


@pytest.fixture(scope="module")
def flown(ray_cluster: None) -> Iterator[Flown]:
    """Rounds with a learner that changes its weights; worker 1 is killed while one is under way."""
    env = small_race(1)
    policy = after(0, env)
    collector = start_workers(
        partial(worlds_of_worker, N // W, policy.make_primer()), policy_of(env), workers=W, share=Share(1.0, 0.0),
        env_device="cpu", frames=FRAMES // W, seed=SEED,
    )  # fmt: skip
    settings = ("body_rate_weight", "worlds.start_on_line")
    rollouts = RayRollouts(collector, policy, env, settings, weight_interval=INTERVAL, patience=120.0, leaves=False)
    rounds, ages, processes = list[TensorDictBase](), list[int](), list[list[tuple[str, int]]]()
    for number in range(ROUNDS):
        rounds.append(next(rollouts))
        ages.append(rollouts.weights_age)
        processes.append(rollouts.processes)
        if number == KILLED_AFTER - 1:
            os.kill(rollouts.processes[1][1], signal.SIGKILL)
        learn(policy, env)
    drained, ages_later = rollouts.drain(), [rollouts.weights_age]
    for _ in AGES_LATER[1:]:
        learn(policy, env)
        next(rollouts)
        ages_later.append(rollouts.weights_age)
    yield Flown(rounds, ages, processes, rollouts, drained, ages_later)
    rollouts.close()


def requests(monkeypatch: pytest.MonkeyPatch) -> list[Request]:
    """What workers have to be asked for, by hand: b₂ as it was when the round before arrived, weights as stated."""
    monkeypatch.setattr("ray.get", lambda weights: weights)  # they are here
    env = small_race(1)
    asked = []
    for number, taken_at in enumerate(TAKEN_AT):
        weights = TensorDict.from_module(after(taken_at, env)).data.clone()
        after(max(0, number - 1), env)
        settings = {"body_rate_weight": env.body_rate_weight, "worlds.start_on_line": 0.0}
        asked.append(Request(number, [as_arrays(weights)], taken_at * FRAMES, settings))
    return asked


def twin(worker: int) -> RayWorker:
    """What a worker is, in this process."""
    policy = policy_of(small_race(1))
    return RayWorker(
        partial(worlds_of_worker, N // W, policy.make_primer()), policy, frames_per_batch=FRAMES // W, total_frames=-1,
        seed=SEED + 1_000_000 * (worker + 1), track_traj_ids=False,
    )  # fmt: skip


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    for key in ("vector", "action", "is_init", "belief", ("next", "reward"), ("next", "done"), ("next", "vector")):
        assert torch.equal(one[key], other[key]), key


# --- before the workers of `flown` take all cores ---------------------------------------------------------------------


def without_a_renderer() -> None:
    raise RuntimeError("EGL is not there")


def of_the_learner_alone() -> None:
    """Not to be found where workers are."""


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
@pytest.mark.parametrize(
    ("make_env", "words"),
    [
        (of_the_learner_alone, r"node .* cannot run a worker \(ModuleNotFoundError: No module named 'here_alone'\)"),
        (without_a_renderer, r"node .* cannot run a worker \(RuntimeError: EGL is not there\)"),
    ],
)
def test_what_workers_cannot_be_made_of_is_refused_at_once(
    ray_cluster: None, make_env: Callable[[], None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_the_learner_alone, "__module__", "here_alone")
    here_alone = ModuleType("here_alone")
    here_alone.of_the_learner_alone = of_the_learner_alone  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "here_alone", here_alone)
    with pytest.raises(ValueError, match=words):
        start_workers(
            make_env, policy_of(small_race(1)), workers=1, share=Share(1.0, 0.0), env_device="cpu", frames=1, seed=0
        )


# --- workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_workers_fly_what_a_single_process_would(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same seeds, weights and b₂, bit for bit; a worker that was restarted, as one with a seed of its own."""
    asked, worlds = requests(monkeypatch), N // W
    with torch.random.fork_rng():
        survivor = twin(0)
        for number, request in enumerate(asked):
            flight = survivor.collect_rollout(request)
            assert_same(flown.rounds[number][:worlds], unpack_rollout(flight.rollout))
            assert survivor.collect_rollout(request) is flight, "asked again, it does not fly on"
        lost = twin(1)
        for number, request in enumerate(asked[: flown.lost_in]):
            assert_same(flown.rounds[number][worlds:], unpack_rollout(lost.collect_rollout(request).rollout))
        successor = twin(1)
        for number, request in enumerate(asked[flown.lost_in :], flown.lost_in):
            assert_same(flown.rounds[number][worlds:], unpack_rollout(successor.collect_rollout(request).rollout))


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_worker_that_is_killed_is_replaced_and_no_frame_is_lost_or_counted_twice(flown: Flown) -> None:
    assert flown.rollouts.lost == 1 and flown.rollouts.rounds == ROUNDS + len(AGES_LATER)
    assert flown.lost_in in (KILLED_AFTER, KILLED_AFTER + 1)
    assert {processes[0] for processes in flown.processes} == {flown.processes[0][0]}, "the other one flew on"
    assert flown.drained is not None
    rounds = [*flown.rounds, flown.drained]
    assert all(rollout.shape == (N, T) for rollout in rounds)
    path = torch.cat(rounds, 1)  # [N, 10 T]
    begins, ended = path["is_init"][:, 1:, 0], path["next", "done"][:, :-1, 0]
    broken = torch.zeros_like(begins)
    broken[N // W :, flown.lost_in * T - 1] = True  # the lost worker's worlds, before what its successor flew
    assert torch.equal(begins, ended | broken) and (ended & ~broken).any()
    goes_on = ~begins
    for key in ("vector", "belief", "state", "previous_action"):
        assert torch.equal(path["next", key][:, :-1][goes_on], path[key][:, 1:][goes_on]), key

    replay, tracker = make_replay(4000, N, 2, 4, observation_keys=("vector",)), EpisodeTracker(N)
    lengths = []
    for rollout in rounds:
        replay.extend(rollout)
        lengths += tracker.update(rollout)["length"].tolist()
    assert len(replay) == path.numel() + int(path["is_init"].sum()), "a record for each step, and one for each start"
    assert max(lengths) <= 12, "no episode is counted on over the loss"


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_weights_are_no_older_than_stated_and_sent_no_sooner_than_needed(flown: Flown) -> None:
    assert flown.ages == [FRAMES * (number + 1 - taken_at) for number, taken_at in enumerate(TAKEN_AT)]
    assert max(flown.ages) == INTERVAL
    assert flown.ages_later == AGES_LATER, "what was under way is learned from before the next is asked"


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_more_workers_than_there_is_room_for_are_refused(flown: Flown) -> None:
    env = small_race(1)
    policy = policy_of(env)
    words = r"num_workers=1 with workers\.cpus=1 need 1 CPUs, and the Ray cluster has 2, of which 0 are free"
    with pytest.raises(ValueError, match=words):
        start_workers(
            partial(worlds_of_worker, 1, policy.make_primer()), policy, workers=1, share=Share(1.0, 0.0),
            env_device="cpu", frames=1, seed=0,
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_an_error_in_flight_is_told_and_ends_the_rounds(flown: Flown) -> None:
    """And is no loss, after which Ray would ask again."""
    assert flown.rollouts.drain() is not None
    wrong = Request(ROUNDS + len(AGES_LATER) + 1, [], 0, {"nowhere.at_all": 1})
    flown.rollouts._asked = [worker.collect_rollout.remote(wrong) for worker in flown.rollouts._workers]
    with pytest.raises(WorkerError, match=r"Worker 0 failed \(AttributeError: .*nowhere.*\)\."):
        flown.rollouts.drain()
    assert flown.rollouts.drain() is None and next(flown.rollouts, None) is None


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_who_does_not_answer_is_waited_for_with_patience_and_shortly_by_a_run_that_stops(
    ray_cluster: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = pytest.importorskip("ray")
    never = ray.remote(num_cpus=0)(lambda: time.sleep(1000.0))

    def waiting() -> RayRollouts:
        env = small_race(1)
        collector = SimpleNamespace(remote_collectors=[None], frames_per_batch=FRAMES)
        rollouts = RayRollouts(collector, policy_of(env), env, weight_interval=INTERVAL, patience=1.5)  # type: ignore[arg-type]
        rollouts._asked = [never.remote()]
        return rollouts

    with pytest.raises(WorkerError, match=r"Worker 0 of 1 did not answer .*workers\.patience=1\.5.*num_workers="):
        next(waiting())
    monkeypatch.setattr("dreamer_racing.experience.ray_rollouts.STOP_TIMEOUT", 0.5)
    stopped = waiting()
    stopped.stopping = lambda: True
    assert next(stopped, None) is None and stopped.drain() is None
