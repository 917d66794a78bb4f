"""Parts of a training run around its learner: session, checkpoints, metrics, schedules, progress."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
