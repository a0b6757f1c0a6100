"""Measured records with a free licence, small enough to ship."""
