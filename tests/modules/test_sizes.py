import pytest
import torch

from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.sizes import SIZES, get_size

# Parameters in millions, counted in other implementations of the same architectures.
PARAMETERS = {
    "size1m": 0.69,
    "size12m": 10.5,
    "size25m": 23.5,
    "size50m": 41.6,
    "size100m": 93.5,
    "size200m": 166,
    "paper_large": 76.7,
}


@pytest.mark.parametrize("name", SIZES)
def test_sizes_have_their_number_of_parameters(name):
    with torch.device("meta"):
        agent = Agent(SIZES[name], Interface())
    count = sum(parameter.numel() for parameter in agent.parameters() if parameter.requires_grad)
    assert count / 1e6 == pytest.approx(PARAMETERS.get(name, count / 1e6), rel=0.01)
    assert get_size(name) is SIZES[name]


def test_unknown_size_lists_the_known_ones():
    with pytest.raises(ValueError, match="'huge'.*debug.*cpu_small.*paper_large"):
        get_size("huge")
