"""Studies: pure functions from data to tables, one module per kind of question."""
