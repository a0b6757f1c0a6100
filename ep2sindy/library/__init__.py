"""The library: candidate terms, their names and units, and how equations are written."""
