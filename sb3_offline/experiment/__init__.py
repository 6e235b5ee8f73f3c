"""Runs: a config becomes a trained policy, a policy becomes a success rate. Knows algorithms, datasets and environments."""
