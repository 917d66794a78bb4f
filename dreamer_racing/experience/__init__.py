"""Collection of rollouts, and their storage: replay buffer and on-policy rollout storage."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
