import pytest
import torch

from dreamer_racing.envs.worlds import RaceWorlds


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
    worlds.close()


def test_other_gates_fit_worse_than_those_that_were_seen() -> None:
    worlds = RaceWorlds("kidney", num_envs=64, from_pixels=False, start_on_line=1.0)
    worlds.reset()
    vector = worlds.vector() + 0.02 * torch.randn(64, 21)  # as a model that is not exact decodes it
    gate = worlds.race.target_gate
    misfits = [worlds.race_vector.pose(vector, (gate + offset) % worlds.track.num_gates)[2] for offset in (0, -1, 1)]
    assert (torch.stack(misfits).argmin(0) == 0).float().mean() > 0.9
    position = worlds.race_vector.pose(vector, gate)[0]
    assert (position - worlds.simulator.state.position).norm(dim=-1).median() < 0.5
    worlds.close()
