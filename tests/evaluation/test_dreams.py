"""What shows a world model's latents; how dreams are stored is tested in tests/figures/test_flights.py."""

import torch

from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.evaluation.dreams import BelievedView, find_painter
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of


def flown(worlds: RaceWorlds, steps: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Race vectors (N, T, 21), images (N, T, H, W, 3) and target gates (N, T) of a flight."""
    worlds.reset()
    seen = []
    for _ in range(steps):
        worlds.step(torch.zeros(worlds.num_envs, 4))
        seen.append((worlds.vector(), worlds.render(), worlds.race.target_gate.clone()))
    vector, images, gate = (torch.stack(parts, 1) for parts in zip(*seen, strict=True))
    return vector, images, gate


def test_who_believes_the_truth_sees_what_the_camera_saw() -> None:
    """Latents that are the race vector, over more frames than there are worlds; the drones stay where they are."""
    worlds = RaceWorlds("kidney", num_envs=3, start_on_line=1.0)
    vector, images, gate = flown(worlds, 4)
    before = worlds.simulator.state.position.clone()
    painter = BelievedView(torch.nn.Identity(), worlds)
    views = painter(vector[..., :9], vector[..., 9:], gate)
    assert views.shape == images.shape and views.dtype == torch.uint8
    difference = (views.int() - images.int()).abs()
    assert (difference > 8).float().mean() < 0.002, "but for edges, by the rounding of float32"
    assert torch.equal(worlds.simulator.state.position, before)
    early = painter(vector[..., :9], vector[..., 9:], (gate + 1) % worlds.track.num_gates)
    assert ((early.int() - images.int()).abs() > 8).float().mean() < 0.002, (
        "the model passes a gate later than the flight"
    )
    worlds.close()


def test_a_model_that_believes_nonsense_is_shown_all_the_same() -> None:
    worlds = RaceWorlds("kidney", num_envs=2)
    painter = BelievedView(torch.nn.Identity(), worlds)
    for nonsense in (torch.nan, torch.inf, 1e30, 0.0):
        vector = torch.full((1, 3, 21), nonsense)
        assert painter(vector[..., :9], vector[..., 9:], torch.zeros(1, 3, dtype=torch.int64)).shape == (
            1,
            3,
            64,
            64,
            3,
        )
    worlds.close()


def test_latents_are_shown_by_what_decodes_them() -> None:
    worlds = RaceWorlds("kidney", num_envs=2)
    decoders = {"reconstruction": True, "privileged": True, "decoder_free": False, "informed": True}
    for world_model, shown in decoders.items():
        learner = learner_of("debug", Interface(privileged_dim=21), world_model=world_model)
        painter = find_painter(learner, worlds)
        assert (painter is not None) == shown, world_model
        if painter is not None:
            size = learner.size
            belief, state = torch.zeros(1, 3, size.belief), torch.zeros(1, 3, size.state)
            images = painter(belief, state, torch.zeros(1, 3, dtype=torch.int64))
            assert images.shape == (1, 3, 64, 64, 3) and images.dtype == torch.uint8
    worlds.close()
