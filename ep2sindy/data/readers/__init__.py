"""Open files of many kinds: one file per kind, all giving a `Source`."""
