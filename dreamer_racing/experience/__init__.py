"""What a policy meets: collected, dealt to streams, kept in a replay."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
