"""Model-free baselines: PPO and SAC with the paper's networks on TorchRL's losses."""

from dreamer_racing.baselines.networks import BaselinePolicy, NetworkSize
from dreamer_racing.baselines.ppo import PPOConfig, PPOLearner
from dreamer_racing.baselines.sac import SACConfig, SACLearner

__all__ = ["BaselinePolicy", "NetworkSize", "PPOConfig", "PPOLearner", "SACConfig", "SACLearner"]
