"""The SAC agents that ``sb3-offline collect-sac`` rolls out: training, choice of checkpoints, and their files."""
