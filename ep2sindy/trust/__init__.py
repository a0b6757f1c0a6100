"""Code that a config names, results as they were written, free memory, and early ends of a run."""
