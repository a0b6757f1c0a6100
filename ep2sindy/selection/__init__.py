"""Selection: rules that choose one candidate from every Pareto front."""
