"""States and coefficients together: sparse equations by the likelihood of whole trajectories."""
