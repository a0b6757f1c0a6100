"""The machine: files written whole or not at all, and pieces of work over its cores."""
