"""Batched simulators: N drones in N worlds, stepped and rendered together.

`MujocoSimulator` runs on CPU, `WarpSimulator` on a CUDA device; both are a `Simulator`, and `simulators.make_simulator`
chooses. `scene` defines the scene and `opengl` renders it, both without torch.
"""
