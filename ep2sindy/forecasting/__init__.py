"""Forecasts: where a model goes from the end of a record, how certain that is, and how good."""
