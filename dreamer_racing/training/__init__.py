"""What a training run is made of, beside its learner."""

import dreamer_racing.envs  # noqa: F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
