"""Constraints: relations between coefficients, and fits that keep them."""
