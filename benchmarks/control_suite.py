"""Frames per second of the control suite's tasks in this machine's OpenGL, and how far the images are dm_control's.

    python benchmarks/control_suite.py --json results/control_suite.json

Every way draws the same states of an episode with random actions, in turns. `cpu_ms` is the median over frames of the
time of all threads, and `times` how many times less it is than that of `physics.render`: it hardly depends on other
load on the machine. `frames/s` does, and is from the fastest tenth of the frames. `mean` and `max` are absolute
differences of 255 from the image of `physics.render`, `worst` is the mean of the worst image.

* `physics.render`: dm_control's own, with a camera and a scene made for each frame;
* `kept camera`: one `Camera` for all frames, with a buffer of the image's size;
* `ControlSuiteEnv`: the same with the detail of `dreamer_racing.envs.control_suite.DETAIL`.
"""

import argparse
import importlib.metadata
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from measuring import print_table, write_json

from dreamer_racing.envs import control_suite as dmc
from dreamer_racing.envs import dm_control_gl

TASKS = ("cartpole_swingup", "walker_walk", "reacher_easy", "cheetah_run", "ball_in_cup_catch", "finger_spin",
         "hopper_hop", "quadruped_walk", "humanoid_walk")  # fmt: skip
COLUMNS = ("task", "way", "frames_per_s", "cpu_ms", "times", "mean", "worst", "max")
STEPS = 5  # simulator steps between two states

Draw = Callable[[], np.ndarray]


def main() -> None:
    """Measure every task asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="*", default=TASKS)
    parser.add_argument("--image-size", type=int, default=64, help="pixels")
    parser.add_argument("--frames", type=int, default=100, help="states drawn, at most 190")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = [record for task in arguments.tasks for record in measure(task, arguments.image_size, arguments.frames)]
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def measure(task: str, size: int, frames: int) -> list[dict[str, Any]]:
    """Return the records of one task."""
    number = dmc.CAMERAS.get(dmc.TASKS[task][0], 0)
    reference = begun(task)
    world = dmc.SuiteWorld(task, 0, number, size)
    world.reset()
    ways: dict[str, tuple[Any, Draw]] = {
        "physics.render": (reference, lambda: reference.physics.render(size, size, camera_id=number)),
        "kept camera": kept_camera(task, number, size),
        "ControlSuiteEnv": (world.env, world.observe),
    }
    for _, draw in ways.values():
        draw()  # the first frame compiles shaders
    wall, cpu, differences = defaultdict(list), defaultdict(list), defaultdict(list)
    for state in states(task, frames):
        for name, (env, draw) in ways.items():
            with env.physics.reset_context():
                env.physics.set_state(state)
            start, start_cpu = time.perf_counter(), time.process_time()
            image = draw().astype(int)
            wall[name].append(time.perf_counter() - start)
            cpu[name].append(time.process_time() - start_cpu)
            if name == "physics.render":
                expected = image
            differences[name].append(abs(image - expected))
    world.close()
    for name, (env, _) in ways.items():
        if name != "ControlSuiteEnv":
            env.physics.free()
    cpu_ms = {name: 1e3 * statistics.median(values) for name, values in cpu.items()}
    return [
        {
            "benchmark": "control_suite", "task": task, "way": name, "image_size": size, "frames": frames,
            "opengl": dm_control_gl.BACKEND, "dm_control": importlib.metadata.version("dm-control"),
            "frames_per_s": float(1 / np.quantile(wall[name], 0.1)), "cpu_ms": cpu_ms[name],
            "times": cpu_ms["physics.render"] / cpu_ms[name], "mean": float(np.mean(differences[name])),
            "worst": float(np.mean(differences[name], (1, 2, 3)).max()), "max": int(np.max(differences[name])),
        }
        for name in ways
    ]  # fmt: skip


def begun(task: str) -> Any:
    """The task as the suite makes it, at the beginning of the same episode each time."""
    env = dmc.suite.load(*dmc.TASKS[task], task_kwargs={"random": 0})
    env.reset()
    return env


def states(task: str, count: int) -> Iterator[np.ndarray]:
    """States of an episode with random actions."""
    env, random = begun(task), np.random.default_rng(0)
    action = env.action_spec()
    for _ in range(count):
        for _ in range(STEPS):
            env.step(random.uniform(action.minimum, action.maximum))
        yield env.physics.get_state()


def kept_camera(task: str, number: int, size: int) -> tuple[Any, Draw]:
    """Return the task, and a function that draws it with one camera."""
    env = begun(task)
    env.physics.model.vis.global_.offwidth = env.physics.model.vis.global_.offheight = size
    return env, dmc.mujoco.Camera(env.physics, size, size, number).render


if __name__ == "__main__":
    main()
