"""Flies an exported actor on a real vehicle, or one that is simulated in a process of its own; no torch in here.

Poses come in, images are rendered from them, the actor turns images into setpoints, safety has the last word, a link
carries what is left of it: `pose` → `camera` → `chain` (actor, `safety`) → `sticks` → `links`. See docs/hil.md.
"""
