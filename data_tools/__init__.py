"""Make, inspect and convert datasets. The programs ``sb3-offline collect``, ``inspect`` and so on call this package."""

from pathlib import Path

POLICIES = Path(__file__).parent / "policies"
"""Folder of the shipped SAC checkpoints and of ``policies.json``, which describes them."""
SAMPLES = Path(__file__).parent / "samples"
"""Folder of ``sac_states.h5`` and ``sac_pixels.h5``: four episodes per task of seed 1, compressed."""
