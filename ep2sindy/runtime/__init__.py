"""What runs rely on: files written whole or not at all, workers, threads, kernels, the screen."""
