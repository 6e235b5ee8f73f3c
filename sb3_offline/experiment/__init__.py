"""Single runs: train a policy from a config, and measure how often it succeeds."""
