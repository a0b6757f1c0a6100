"""Protection against untrusted files, configs and folders, and handling of early ends of a run."""
