"""The program: from a command line to a run folder. The one room that knows Hydra."""
