"""The race: tracks, quadrotor physics, batched simulation, and the environments built on them."""
