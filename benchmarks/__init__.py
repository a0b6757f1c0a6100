"""Speed claims, each as a ratio measured in one run on one thread."""
