"""Refinement: coefficients fitted to integrated trajectories; PyTorch is used only here."""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
