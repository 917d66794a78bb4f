"""Networks of the agent, on plain tensors; only `DreamerPolicy` and `LatentFormat` use TensorDict."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
from dreamer_racing.modules.agent import Agent, DreamerPolicy
from dreamer_racing.modules.autoencoder import (
    ImageDecoder,
    ImageEncoder,
    ObservationEncoder,
    VectorDecoder,
    VectorEncoder,
)
from dreamer_racing.modules.heads import (
    MLP,
    ActionDistribution,
    Actor,
    ContinueHead,
    Critic,
    TwoHot,
    TwoHotHead,
    symexp,
    symlog,
)
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.recurrent_cells import BlockGRUCell, DenseGRUCell
from dreamer_racing.modules.rssm import RSSM, Posterior, join_features
from dreamer_racing.modules.sizes import SIZES, ModelSize, get_size
from dreamer_racing.modules.world_model import WorldModel

__all__ = [
    "MLP",
    "RSSM",
    "SIZES",
    "ActionDistribution",
    "Actor",
    "Agent",
    "BlockGRUCell",
    "ContinueHead",
    "Critic",
    "DenseGRUCell",
    "DreamerPolicy",
    "ImageDecoder",
    "ImageEncoder",
    "Interface",
    "ModelSize",
    "ObservationEncoder",
    "Posterior",
    "TwoHot",
    "TwoHotHead",
    "VectorDecoder",
    "VectorEncoder",
    "WorldModel",
    "get_size",
    "join_features",
    "symexp",
    "symlog",
]
