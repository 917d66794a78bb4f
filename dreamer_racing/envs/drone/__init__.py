"""The vehicle: its parameters, and the state of its flight controller and motors."""
