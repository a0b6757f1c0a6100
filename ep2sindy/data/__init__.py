"""Data: trajectories, fields on a grid, the files they come from, and their preparation."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
