"""Command-line experiments: configs in, run folders out."""
