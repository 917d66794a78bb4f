"""Everything drawn or filmed."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
