"""Joint estimation of states and coefficients by the likelihood of whole trajectories."""
