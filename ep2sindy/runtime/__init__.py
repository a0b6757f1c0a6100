"""Services for runs: atomic file output, workers, threads, compiled kernels, progress, display."""
