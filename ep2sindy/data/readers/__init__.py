"""Readers of many kinds of file, in one module per family of formats; each gives a `FileSource`."""
