"""Tables of runs: a grid of methods, tasks and seeds from one YAML file becomes a CSV file, whatever is killed on the way."""
