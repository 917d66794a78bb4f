"""A simulated drone in a separate process, with this project's physics, in place of a real one.

`vehicle` is the drone, with its differences from the training model; `commands` or `betaflight_sitl` controls it;
`delivery` sends its poses as a motion-capture system would; `process` runs it by the wall clock.
"""

import dreamer_racing.envs  # noqa: F401 - before MuJoCo, whose variables it heeds
