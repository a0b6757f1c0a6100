"""Refinement: coefficients fitted to integrated trajectories; only this package uses PyTorch."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
