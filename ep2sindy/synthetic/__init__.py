"""Synthetic data: systems whose equations are known, to be found again."""
