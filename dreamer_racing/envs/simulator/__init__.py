"""Batched simulators: N drones in N worlds, stepped and rendered together.

`MujocoSimulator` runs on CPU, `WarpSimulator` on a CUDA device; both are a `Simulator`, and `backends.make_simulator`
chooses. `scene` and `opengl` are what is drawn and how, and do without torch.
"""
