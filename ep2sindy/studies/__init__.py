"""Studies: one file per experiment, from its settings to an outcome that can be read."""
