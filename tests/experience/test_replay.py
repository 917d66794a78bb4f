"""The replay against a slow reference that keeps one Python list per environment."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from dreamer_racing.experience.replay import StreamReplay, make_replay
from dreamer_racing.experience.replay_place import replay_bytes
from dreamer_racing.experience.streams import records_from_rollout
from dreamer_racing.modules.rssm import LatentFormat
from tests.launches import launches

REWARDS = ("reward", "reward_base", "body_rate_norm")
KEYS = ("pixels", "previous_action", *REWARDS, "is_init", "terminated", "truncated")


class CountingEnv(EnvBase):
    """N environments whose image is (environment, observations seen // 256, observations seen % 256, 0, ...)."""

    def __init__(self, num_envs: int, seed: int = 0, end: float = 0.2, image_shape: tuple[int, ...] = (2, 2, 2)):
        super().__init__(batch_size=[num_envs])
        self.end = end
        self.image_shape = image_shape
        self.generator = torch.Generator().manual_seed(seed)
        self.seen = torch.zeros(num_envs, dtype=torch.int64)
        shape = (num_envs, 1)
        self.observation_spec = Composite(
            pixels=Unbounded((num_envs, *image_shape), dtype=torch.uint8),
            reward_base=Unbounded(shape),
            body_rate_norm=Unbounded(shape),
            shape=[num_envs],
        )
        self.action_spec = Bounded(-1, 1, (num_envs, 4))
        self.reward_spec = Unbounded(shape)
        flag = Binary(1, shape, dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=[num_envs])

    def _observation(self) -> dict[str, torch.Tensor]:
        image = torch.zeros(len(self.seen), *self.image_shape, dtype=torch.uint8)
        flat = image.flatten(1)
        flat[:, 0], flat[:, 1], flat[:, 2] = torch.arange(len(self.seen)), self.seen // 256, self.seen % 256
        return {"pixels": image}

    def _rand(self) -> torch.Tensor:
        return torch.rand(len(self.seen), 1, generator=self.generator)

    def _reset(self, tensordict: TensorDict | None = None) -> TensorDict:
        reset = torch.ones(len(self.seen), dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            reset = tensordict["_reset"].squeeze(-1)
        self.seen += reset
        extra = {"reward_base": torch.zeros(len(self.seen), 1), "body_rate_norm": torch.zeros(len(self.seen), 1)}
        return TensorDict({**self._observation(), **extra}, [len(self.seen)])

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.seen += 1
        ended, crashed = self._rand() < self.end, self._rand() < 0.5
        flags = {"done": ended, "terminated": ended & crashed, "truncated": ended & ~crashed}
        return TensorDict({**self._observation(), **flags, **{key: self._rand() for key in REWARDS}}, [len(self.seen)])

    def _set_seed(self, seed: int | None) -> None: ...


def collect(env: CountingEnv, steps: int, batches: int, seed: int = 0) -> list[TensorDict]:
    """What a TorchRL collector yields: ``batches`` rollouts [N, T]."""
    frames = env.batch_size[0] * steps
    torch.manual_seed(seed)  # of the random actions
    collector = Collector(TransformedEnv(env, InitTracker()), None, frames_per_batch=frames, total_frames=-1)
    rollouts = [rollout.clone() for rollout, _ in zip(collector, range(batches), strict=False)]
    collector.shutdown()
    return rollouts


class ReferenceStreams:
    """The record layout of docs/api/training.md, spelled out step by step."""

    def __init__(self, num_envs: int, length: int):
        self.streams: list[list[dict]] = [[] for _ in range(num_envs)]
        self.length = length

    def extend(self, rollout: TensorDict) -> None:
        for env, stream in enumerate(self.streams):
            for time in range(rollout.shape[1]):
                step = rollout[env, time]
                zero, no = torch.zeros(1), torch.zeros(1, dtype=torch.bool)
                if step["is_init"]:
                    first = {"pixels": step["pixels"], "previous_action": torch.zeros(4), "is_init": ~no}
                    stream.append({**first, **dict.fromkeys(REWARDS, zero), "terminated": no, "truncated": no})
                arrived = {key: step["next", key] for key in ("pixels", *REWARDS, "terminated", "truncated")}
                stream.append({**arrived, "previous_action": step["action"], "is_init": no})
            del stream[: -self.length]


def assert_same_stream(replay, reference: ReferenceStreams) -> None:
    for env, expected in enumerate(reference.streams):
        actual = replay.records(env)
        assert len(actual) == len(expected)
        for key in KEYS:
            assert torch.equal(actual[key], torch.stack([record[key] for record in expected])), (env, key)


def counter(pixels: torch.Tensor) -> torch.Tensor:
    """The observation count that `CountingEnv` wrote into images."""
    flat = pixels.flatten(-3)
    return flat[..., 1].long() * 256 + flat[..., 2].long()


def stream(pixels: torch.Tensor) -> torch.Tensor:
    """The environment that `CountingEnv` wrote into images."""
    return pixels.flatten(-3)[..., 0]


FORMAT = LatentFormat(belief=2, latents=1, classes=3)


def with_latents(rollout: TensorDict) -> TensorDict:
    """Latents that tell the step at which they were left: belief (step, environment) / 1000, state step mod 3."""
    envs, steps = rollout.shape
    step = torch.arange(1, steps + 1).expand(envs, steps)
    env = torch.arange(envs).unsqueeze(-1).expand(envs, steps)
    rollout["next", "belief"] = torch.stack((step, env), -1) / 1000
    rollout["next", "state"] = torch.nn.functional.one_hot(step % 3, 3).float()
    return rollout


def filled(num_envs: int = 3, length: int = 20, steps: int = 15, **arguments: Any) -> StreamReplay:
    """A replay of so many records a stream, with a rollout of so many steps."""
    env = CountingEnv(num_envs, image_shape=arguments.pop("image_shape", (2, 2, 2)))
    replay = make_replay(num_envs * length, num_envs, 6, 4, **arguments)
    (rollout,) = collect(env, steps=steps, batches=1)
    replay.extend(with_latents(rollout) if "latents" in arguments else rollout)
    return replay


@settings(deadline=None, max_examples=40)
@given(
    num_envs=st.integers(1, 4),
    length=st.integers(3, 20),
    steps=st.lists(st.integers(1, 25), min_size=1, max_size=6),
    end=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    seed=st.integers(0, 10),
)
def test_writer_equals_the_reference(num_envs, length, steps, end, seed):
    env = TransformedEnv(CountingEnv(num_envs, seed=seed, end=end), InitTracker())
    replay = make_replay(num_envs * length, num_envs, 8, 3)
    reference = ReferenceStreams(num_envs, length)
    generator = torch.Generator().manual_seed(seed)
    current = env.reset()
    written = 0
    for count in steps:
        transitions = []
        for _ in range(count):
            current["action"] = torch.rand(num_envs, 4, generator=generator)
            transition, current = env.step_and_maybe_reset(current)
            transitions.append(transition)
        rollout = torch.stack(transitions, 1)
        written += len(replay.extend(rollout))
        reference.extend(rollout)
        assert_same_stream(replay, reference)
        assert len(replay) == sum(map(len, reference.streams))
        assert replay.write_count == written


@pytest.mark.parametrize("image_shape", [(2, 2, 2), (3, 3, 3)], ids=["words", "bytes"])
@pytest.mark.parametrize("storage", ["tensor", "memmap"])
def test_collector_rollouts_in_every_storage(storage, image_shape, tmp_path):
    rollouts = collect(CountingEnv(3, image_shape=image_shape), steps=7, batches=5)
    replay = make_replay(60, 3, 4, 5, scratch_dir=tmp_path if storage == "memmap" else None)
    reference = ReferenceStreams(3, 20)
    for rollout in rollouts:
        replay.extend(rollout)
        reference.extend(rollout)
    assert_same_stream(replay, reference)
    sample = replay.sample()
    assert sample.batch_size == (4, 5)
    assert sample["pixels"].shape == (4, 5, *image_shape)
    assert set(sample.keys()) == {*KEYS, "index"}


def test_windows_are_consecutive_after_the_ring_wrapped():
    replay = make_replay(3 * 40, 3, 500, 8, seed=1)
    for rollout in collect(CountingEnv(3), steps=9, batches=30):
        replay.extend(rollout)
        if replay.can_sample():
            sample = replay.sample()
            assert (counter(sample["pixels"]).diff(dim=1) == 1).all()
            environment = sample["pixels"].flatten(2)[..., 0]
            assert (environment == environment[:, :1]).all()
            newest = torch.tensor([counter(replay.records(n)["pixels"])[-1] for n in range(3)])
            age = newest[environment[:, 0].long()] - counter(sample["pixels"])[:, -1]
            assert age.min() >= 0 and age.max() <= 32
    assert replay.writer.filled.tolist() == [40, 40, 40]


def test_windows_are_drawn_uniformly():
    replay = make_replay(3 * 30, 3, 30_000, 5, seed=3)
    for rollout in collect(CountingEnv(3, end=0.1), steps=6, batches=3):  # 18 + episodes records a stream
        replay.extend(rollout)
    windows = (replay.writer.filled - 4).clamp(min=0)
    start = replay.sample()["index"][:, 0]
    drawn = torch.bincount(start, minlength=90)
    expected = 30_000 / int(windows.sum())
    assert int((drawn > 0).sum()) == int(windows.sum())
    # Binomial: five standard deviations.
    assert (drawn[drawn > 0] - expected).abs().max() < 5 * expected**0.5


def test_a_share_of_the_windows_is_recent():
    replay = make_replay(2 * 40, 2, 10_000, 4, seed=1, recent_share=0.75, recent_records=2 * 10)
    for rollout in collect(CountingEnv(2, end=0.0), steps=25, batches=3):  # the rings wrap
        replay.extend(rollout)
    newest = counter(replay.records(0)["pixels"])[-1]
    age = newest - counter(replay.sample()["pixels"])  # (B, T)
    assert age[2_500:].max() == 9 and age[2_500:].unique().tolist() == list(range(10))
    assert age[:2_500].max() == 39
    with pytest.raises(ValueError, match="recent_share=1.5"):
        make_replay(100, 1, 1, 4, recent_share=1.5)


def test_streams_that_are_held_out_are_never_sampled():
    replay, plain = (make_replay(3 * 40, 3, 100, 4, seed=3, held_out=2) for _ in range(2))
    for rollout in collect(CountingEnv(3), steps=15, batches=4):
        for each in (replay, plain):
            each.extend(rollout)
        apart = replay.held_out(100, 6)
        assert apart.batch_size == (100, 6) and apart.keys() >= set(KEYS)
        assert stream(apart["pixels"]).unique().tolist() == [1, 2]
        assert (counter(apart["pixels"]).diff(dim=1) == 1).all()
        sample = replay.sample()
        assert stream(sample["pixels"]).unique().tolist() == [0]
        assert torch.equal(sample["pixels"], plain.sample()["pixels"]), "looking at what is held out changed a sample"
    assert stream(make_both(held_out=0).sample()["pixels"]).unique().tolist() == [0, 1]


def make_both(**arguments):
    """A replay of two environments without ends, 31 records of each."""
    replay = make_replay(2 * 40, 2, 500, 4, **arguments)
    replay.extend(collect(CountingEnv(2, end=0.0), steps=30, batches=1)[0])
    return replay


def test_what_is_held_out_may_be_the_newest():
    replay = make_both(held_out=1)
    for recent, ages in ((10, 10), (4, 4), (None, 31), (1_000, 31)):
        age = 31 - counter(replay.held_out(500, 4, recent)["pixels"])
        assert age.unique().tolist() == list(range(ages)), recent
    assert replay.held_out(5, 31).batch_size == (5, 31)
    assert replay.held_out(5, 32) is None, "longer than the stream"
    assert replay.held_out(5, 4, recent=3) is None, "longer than the newest"
    assert make_both(held_out=0).held_out(5, 4) is None, "there is nothing apart"
    assert make_replay(80, 2, 4, 4, held_out=1).held_out(5, 4) is None, "nothing has been written"
    delivered = make_both(held_out=1, device="meta", storage_device="cpu").held_out(5, 4)
    assert {value.device.type for value in delivered.values()} == {"meta"}


def test_the_newest_are_the_last_of_every_stream_in_order():
    replay = make_replay(2 * 40, 2, 500, 4, held_out=1)
    assert replay.newest(1) is None, "nothing has been written"
    for length in (31, 62):  # the second time the rings have wrapped
        replay.extend(collect(CountingEnv(2, end=0.0), steps=30, batches=1)[0])
        newest = replay.newest(5)
        assert newest.batch_size == (2, 5)
        assert stream(newest["pixels"]).tolist() == [[0] * 5, [1] * 5], "held out or not"
        assert counter(newest["pixels"]).tolist() == [[27, 28, 29, 30, 31]] * 2
        assert (replay.newest(min(length, 40) + 1) is None) and replay.newest(min(length, 40)) is not None
    delivered = make_both(device="meta", storage_device="cpu").newest(4)
    assert delivered.device == torch.device("meta")


def test_something_must_be_left_to_sample():
    for held_out in (2, 3, -1):
        with pytest.raises(ValueError, match=f"held_out={held_out} of num_envs=2"):
            make_replay(80, 2, 4, 4, held_out=held_out)
    replay = make_replay(80, 2, 4, 10, held_out=1)
    replay.extend(collect(CountingEnv(2, end=0.0), steps=8, batches=1)[0])
    replay.writer.filled[1] = 20
    assert not replay.can_sample()
    with pytest.raises(RuntimeError, match="longest stream holds 9"):
        replay.sample()


def test_an_environment_without_race_terms():
    rollout = collect(CountingEnv(2), steps=20, batches=1)[0]
    del rollout["next", "reward_base"], rollout["next", "body_rate_norm"]
    with pytest.raises(KeyError, match="'next', 'reward_base'"):
        make_replay(80, 2, 4, 4).extend(rollout)
    replay = make_replay(80, 2, 4, 4, reward_keys=("reward",))
    replay.extend(rollout)
    records = replay.records(0)
    assert set(records.keys()) == {"pixels", "previous_action", "reward", "is_init", "terminated", "truncated"}
    assert torch.equal(records["reward"][~records["is_init"]], rollout["next", "reward"][0].flatten())
    assert (records["reward"][records["is_init"]] == 0).all()
    assert "reward_base" not in replay.sample()


def test_short_streams_are_never_drawn():
    replay = make_replay(40, 2, 64, 6)
    rollout = collect(CountingEnv(2, end=0.0), steps=5, batches=1)[0]
    replay.extend(rollout)  # six records each
    assert replay.can_sample()
    replay = make_replay(40, 2, 64, 7)
    replay.extend(rollout)
    assert not replay.can_sample()
    with pytest.raises(RuntimeError, match="batch_length=7 .* longest stream holds 6"):
        replay.sample()
    replay.writer.filled[1] += 1
    assert (replay.sample()["index"] >= 20).all()


def test_dump_and_load_continue_the_same_samples(tmp_path):
    rollouts = collect(CountingEnv(3), steps=15, batches=4)
    replay = make_replay(150, 3, 6, 4, seed=5)
    restored = make_replay(150, 3, 6, 4, seed=6, scratch_dir=tmp_path / "maps")
    for rollout in rollouts[:2]:
        replay.extend(rollout)
    replay.sample()
    replay.dump(tmp_path)
    restored.load(tmp_path)
    assert len(restored) == len(replay) and restored.write_count == replay.write_count
    for rollout in rollouts[2:]:
        for _ in range(3):
            assert (replay.sample() == restored.sample()).all()
        replay.extend(rollout)
        restored.extend(rollout)
    assert (replay.sample() == restored.sample()).all()


def test_an_empty_replay_is_saved_too(tmp_path):
    emptied = filled()
    emptied.empty()
    for replay in (make_replay(60, 3, 6, 4), emptied):
        replay.dump(tmp_path)
        restored = make_replay(60, 3, 6, 4)
        restored.load(tmp_path)
        assert len(restored) == len(restored.records(0)) == 0


@pytest.mark.parametrize(
    ("saved", "here", "words"),
    [
        ({}, {"num_envs": 2}, "3 streams of 20 records, this one has 2 of 20"),
        ({}, {"length": 30}, "3 streams of 20 records, this one has 3 of 30"),
        ({}, {"image_shape": (3, 3, 3)}, "pixels"),
        ({"reward_keys": ("reward",)}, {}, "stores 'reward_base', which the saved one does not have"),
    ],
    ids=["streams", "records", "shape", "field"],
)
def test_load_refuses_another_layout_and_leaves_what_is_there(tmp_path, saved, here, words):
    filled(**saved).dump(tmp_path)
    other = filled(steps=5, **here)
    before = other.records(0).clone()
    with pytest.raises(ValueError, match=words):
        other.load(tmp_path)
    assert (other.records(0) == before).all()


@pytest.mark.parametrize("kept", [True, False])
def test_a_replay_with_latents_and_one_without_are_told_apart(kept, tmp_path):
    with_them, without = {"latents": FORMAT}, {}
    filled(**(with_them if kept else without)).dump(tmp_path)
    other = make_replay(60, 3, 6, 4, **(without if kept else with_them))
    with pytest.raises(ValueError, match=f"resume with replay.context={str(kept).lower()}"):
        other.load(tmp_path)


def test_repeated_records_compress_well(tmp_path):
    replay = make_replay(600, 2, 6, 4)
    replay.extend(collect(CountingEnv(2, image_shape=(64, 64, 3)), steps=200, batches=1)[0])  # images of one colour
    replay.dump(tmp_path)
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < replay_bytes(len(replay)) / 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda field: field.update(shape=[2, 2, 3]), "does not hold .* values of torch.uint8"),
        (lambda field: field.update(dtype="torch.int64"), "does not hold .* values of torch.int64"),
        (lambda field: field["frames"].pop(), "does not hold a frame for each of 3 streams"),
        (None, "is damaged"),
    ],
)
def test_load_refuses_what_does_not_fit_together(tmp_path, change, message):
    filled().dump(tmp_path)
    state = json.loads((tmp_path / "replay.json").read_text())
    if change:
        change(next(field for field in state["fields"] if field["key"] == "pixels"))
        (tmp_path / "replay.json").write_text(json.dumps(state))
    else:
        with (tmp_path / "0.zst").open("r+b") as frames:
            frames.write(bytes(4))
    with pytest.raises(ValueError, match=message):
        make_replay(60, 3, 6, 4).load(tmp_path)


def test_errors_say_what_is_wrong():
    rollout = collect(CountingEnv(3), steps=5, batches=1)[0]
    with pytest.raises(ValueError, match="at least 64"):
        make_replay(10, 1, 6, 64)
    with pytest.raises(ValueError, match="has 3 environments, the replay was made for 2"):
        make_replay(100, 2, 6, 4).extend(rollout)
    with pytest.raises(KeyError, match="InitTracker"):
        records_from_rollout(rollout.exclude("is_init"))
    with pytest.raises(ValueError, match=r"\[environments, time\]"):
        records_from_rollout(rollout[0])
    replay = make_replay(100, 3, 6, 4)
    replay.extend(rollout)
    rollout["pixels"], rollout["next", "pixels"] = rollout["pixels"].int(), rollout["next", "pixels"].int()
    with pytest.raises(ValueError, match="stores 'pixels' as .*uint8"):
        replay.extend(rollout)


def test_size_is_known_before_allocation():
    assert filled().storage._storage.bytes() == replay_bytes(60, (2, 2, 2))
    assert replay_bytes(1_000_000) == pytest.approx(12.3e9, rel=0.01)


def test_context_is_what_was_left_before_each_observation_and_zero_at_first_ones():
    replay = make_replay(60, 3, 6, 4, latents=FORMAT)
    (rollout,) = collect(CountingEnv(3), steps=12, batches=1)
    replay.extend(with_latents(rollout))
    for env in range(3):
        records = replay.records(env)
        arrived = ~records["is_init"].squeeze(-1)
        belief, state = FORMAT.unpack(records["context"])
        expected = torch.stack((torch.arange(1, 13), torch.full((12,), env)), -1) / 1000
        torch.testing.assert_close(belief[arrived], expected, atol=1e-5, rtol=0)
        assert state[arrived].argmax(-1).tolist() == [step % 3 for step in range(1, 13)]
        assert not belief[~arrived].any()


def test_refreshing_reaches_the_records_after_those_seen_and_no_others():
    replay = make_replay(39, 3, 2, 4, latents=FORMAT)  # full
    (rollout,) = collect(CountingEnv(3, end=0.0), steps=12, batches=1)
    replay.extend(with_latents(rollout))
    before = replay.storage._storage.clone()
    batch = replay.sample()
    belief, state = torch.full((2, 4, 2), 0.5), torch.nn.functional.one_hot(torch.full((2, 4), 2), 3).float()
    replay.refresh(batch["index"], belief, state)
    after = replay.storage._storage
    touched = torch.zeros(len(before), dtype=torch.bool)
    touched[batch["index"][:, 1:].flatten()] = True
    assert (after["context", "belief"][touched] == 0.5).all() and (after["context", "state"][touched] == 2).all()
    for key, value in before.items(include_nested=True, leaves_only=True):
        unchanged = ~touched if key[0] == "context" else slice(None)
        assert torch.equal(after[key][unchanged], value[unchanged]), key


def test_where_windows_overlap_the_last_one_is_kept_and_nobody_waits():
    replay = make_replay(39, 3, 2, 4, latents=FORMAT)
    replay.extend(with_latents(collect(CountingEnv(3, end=0.0), steps=12, batches=1)[0]))
    slots = torch.tensor([[2, 3, 4, 5], [3, 4, 5, 6]])
    belief = torch.arange(8.0).view(2, 4, 1).expand(2, 4, 2) / 8  # exact in float16
    for shift in (0.0, 0.5):  # what the first call remembers of slots must not show in the second
        seen = launches(lambda shift=shift: replay.refresh(slots, belief + shift, torch.zeros(2, 4, 3)))
        assert (seen.waits, seen.mixed) == ([], [])
        kept = replay.storage._storage["context", "belief"][3:7, 0] - shift
        assert (8 * kept).tolist() == [0, 4, 5, 6], "of slots 4 and 5 the second window's"


def test_samples_are_drawn_without_waiting():
    replay = filled(latents=FORMAT, recent_share=0.5)
    slots = replay._sampler.sample(replay.storage, 6)[0]  # on the CPU, whatever the storage is on
    seen = launches(lambda: replay.storage.get(slots))
    assert (seen.waits, seen.mixed) == ([], []) and seen.count > 0


@pytest.mark.parametrize("kept_on", ["meta", "cpu"])
def test_what_comes_with_a_sample_is_brought_without_waiting(kept_on):
    replay = filled(device="meta", storage_device=kept_on, recent_share=0.5)  # in a GPU's place
    seen = launches(replay.sample)
    assert {place.split(" at ")[1].split(":")[0] for place in seen.mixed} <= {
        "experience/streams.py",  # `send`
        "experience/replay.py",  # the delivery
    }, seen.mixed
    assert {value.device.type for value in replay.sample().values()} == {"meta"}
    assert replay.records(0)["pixels"].device.type == kept_on


@pytest.mark.gpu
def test_a_replay_on_cuda_is_written_sampled_and_refreshed_as_one_on_the_cpu():
    samples = []
    for device in ("cpu", "cuda"):
        replay = make_replay(60, 3, 6, 4, device=device, latents=FORMAT)
        for rollout in collect(CountingEnv(3), steps=5, batches=3):
            replay.extend(with_latents(rollout).to(device))
        batch = replay.sample()
        latents = torch.full((6, 4, 2), 0.5, device=device), torch.ones(6, 4, 3, device=device)
        replay.refresh(batch["index"], *latents)
        torch.cuda.set_sync_debug_mode("error" if device == "cuda" else "default")
        try:
            replay.refresh(batch["index"], *latents)
            sample = replay.sample()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert sample["pixels"].device.type == device
        samples.append(sample.cpu())
    assert (samples[0] == samples[1]).all()


def test_context_survives_a_checkpoint_and_counts_in_the_size(tmp_path):
    replay, restored = filled(seed=5, latents=FORMAT), make_replay(60, 3, 6, 4, seed=6, latents=FORMAT)
    assert replay.storage._storage.bytes() == replay_bytes(60, (2, 2, 2), latents=FORMAT)
    replay.dump(tmp_path)
    restored.load(tmp_path)
    assert (replay.sample() == restored.sample()).all()


def test_a_rollout_without_latents_is_refused_where_they_are_kept():
    replay = make_replay(60, 3, 6, 4, latents=FORMAT)
    with pytest.raises(KeyError, match="'belief'.*'state'"):
        replay.extend(collect(CountingEnv(3), steps=5, batches=1)[0])
