"""Flying a policy and measuring it, and its world model."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
