"""Selection: rules that choose one candidate of every front."""
