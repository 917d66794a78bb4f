"""What a vehicle's answers to commands say of it: the numbers of its rate loop, motors and thrust.

`recorded` reads a flight of `recipes/hil.py`, or a table; `fitting` finds the parameters with which this project's own
simulation answers the same; `envs.drone.saved` keeps them as a file that ``preset=`` takes.
"""
