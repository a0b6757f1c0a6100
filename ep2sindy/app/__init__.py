"""The program, from a command line to a run folder. Only this package imports Hydra."""
