"""Flies an exported actor on a real vehicle, or on one simulated in a separate process, without importing torch.

Poses arrive, images are rendered from them, the actor turns images into setpoints, safety checks and limits these, and
a link sends the result: `pose` → `camera` → `chain` (actor, `safety`) → `sticks` → `links`. See docs/hil.md.
"""
