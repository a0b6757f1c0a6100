"""Figures: values in, a matplotlib Figure out."""
