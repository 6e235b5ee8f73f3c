"""Tables of runs: a grid of methods, tasks and seeds in one YAML file becomes a CSV file. Killed runs continue exactly."""
