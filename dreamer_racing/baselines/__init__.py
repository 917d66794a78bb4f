"""Model-free baselines: PPO and SAC with the paper's networks on TorchRL's losses."""

from dreamer_racing.baselines.networks import BaselinePolicy, NetworkSize
from dreamer_racing.baselines.ppo import PPOConfig, PPOLearner

__all__ = ["BaselinePolicy", "NetworkSize", "PPOConfig", "PPOLearner"]
