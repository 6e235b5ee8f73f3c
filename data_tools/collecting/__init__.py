"""Collect datasets: roll out scripted policies or trained SAC agents in the multimodal Meta-World."""
