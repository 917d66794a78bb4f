"""The other end of a flight: a drone of this project's physics in a process of its own, where a real one would be.

`vehicle` is the drone, with what sets it apart from the one that was trained on; `commands` or `betaflight_sitl` moves
it; `delivery` sends its poses as a motion-capture system would; `process` keeps all of it in time.
"""

import dreamer_racing.envs  # noqa: F401 - before MuJoCo, whose variables it heeds
