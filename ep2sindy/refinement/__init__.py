"""Refinement: coefficients fitted to integrated trajectories; PyTorch lives here."""
