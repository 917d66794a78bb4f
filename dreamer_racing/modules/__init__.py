"""The agent's networks; plain tensors inside, TensorDict only in ``DreamerPolicy``."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
from dreamer_racing.modules.actor import ActionDistribution, Actor
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.critic import Critic
from dreamer_racing.modules.decoder import ImageDecoder, VectorDecoder
from dreamer_racing.modules.encoder import ImageEncoder, ObservationEncoder, VectorEncoder
from dreamer_racing.modules.heads import MLP, ContinueHead, TwoHot, TwoHotHead, symexp, symlog
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.parallel_rssm import DiagonalSSM, ParallelRSSM
from dreamer_racing.modules.policy import DreamerPolicy
from dreamer_racing.modules.recurrent_cells import BlockGRUCell, DenseGRUCell
from dreamer_racing.modules.rssm import RSSM, Posterior
from dreamer_racing.modules.sizes import SIZES, ModelSize, get_size
from dreamer_racing.modules.world_model import WorldModel, join_features

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
    "DiagonalSSM",
    "DreamerPolicy",
    "ImageDecoder",
    "ImageEncoder",
    "Interface",
    "ModelSize",
    "ObservationEncoder",
    "ParallelRSSM",
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
