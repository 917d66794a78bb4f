"""Learners: DreamerV3, PPO in world-model latents, and the model-free baselines PPO and SAC on TorchRL's losses."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
from dreamer_racing.learners.baseline import BaselinePolicy, NetworkSize
from dreamer_racing.learners.ppo import PPOConfig, PPOLearner
from dreamer_racing.learners.sac import SACConfig, SACLearner

__all__ = ["BaselinePolicy", "NetworkSize", "PPOConfig", "PPOLearner", "SACConfig", "SACLearner"]
