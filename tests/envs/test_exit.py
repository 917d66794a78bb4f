"""Programs that end without closing their environments end well."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os
import sys

import gymnasium
import torch  # what takes long is imported once, before the processes part

import dreamer_racing.envs.gym_vector_env
import dreamer_racing.envs.sb3_env
from dreamer_racing.envs import DroneRacingEnv

for number in range(10):
    child = os.fork()
    if not child:
        break
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status:
        sys.exit(f"process {number} ended with {status}")
else:
    sys.exit()
KINDS = (
    lambda: gymnasium.make("dreamer_racing/Circle-v0"),
    lambda: gymnasium.make_vec("dreamer_racing/Circle-v0", num_envs=2),
    lambda: dreamer_racing.envs.sb3_env.DroneRaceVecEnv("circle", 2),
    lambda: DroneRacingEnv("circle", 2),
)
first, second = KINDS[number % 4](), KINDS[(number + 1) % 4]()
for env in (first, second):
    env.reset()
    print("drawn")
"""


@pytest.mark.slow
def test_ten_processes_that_close_nothing_end_with_status_zero() -> None:
    pytest.importorskip("stable_baselines3")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["drawn"] * 20
