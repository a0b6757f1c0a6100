"""Data: trajectories, fields on a grid, the files they come from, and their preparation."""
