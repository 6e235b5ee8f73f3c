"""Which code and which packages produced a file."""

import importlib.metadata
import subprocess
from collections.abc import Iterable
from pathlib import Path

SIMULATION_PACKAGES = ("metaworld", "mujoco", "gymnasium", "numpy")
"""The packages that decide what happens in an episode."""
TRAINING_PACKAGES = ("torch", "stable_baselines3", "gymnasium", "numpy", "metaworld", "mujoco")
"""The packages that decide the result of a training run and its evaluation."""


def current_commit() -> str:
    """
    :return: the commit of this code, with a + if the code differs from it; "unknown" outside a repository
    """
    root = Path(__file__).parents[2]
    code = ["sb3_offline", "zoo_configs", "data_tools"]

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if not git("ls-files", "sb3_offline/version.txt"):
            return "unknown"  # the package is installed inside another project's repository
        return git("rev-parse", "--short=9", "HEAD") + "+" * bool(git("status", "--porcelain", *code))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """
    :param packages: names of packages
    :return: version by name, without the packages that are not installed
    """
    versions = {}
    for name in packages:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
