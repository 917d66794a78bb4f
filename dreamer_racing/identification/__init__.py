"""System identification: finds a vehicle's rate loop, motors and thrust from its response to commands.

`recorded` reads a flight of `recipes/hil.py`, or a table; `fitting` finds the parameters with which this project's own
simulation responds the same; `envs.drone.parameters.save_drone` keeps them as a file that ``preset=`` takes.
"""
