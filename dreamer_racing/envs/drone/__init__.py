"""The vehicle: its parameters, rotations, and one step of its motion."""
