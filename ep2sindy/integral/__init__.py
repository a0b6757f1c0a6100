"""Integral least squares: windows of data, and the ways to fit a model's trajectories to them."""
