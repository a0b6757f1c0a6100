"""Regression: rows of terms and targets, in each form that the data can be brought to."""
