"""``python -m sb3_offline.zoo.train``: rl_zoo3's own program, for offline algorithms as well."""

import sys

import rl_zoo3.train

from sb3_offline.zoo.manager import OfflineExperimentManager

rl_zoo3.train.ExperimentManager = OfflineExperimentManager  # type: ignore[misc]


def main() -> None:
    """Train, or optimise with Optuna, as ``sys.argv`` says."""
    try:
        rl_zoo3.train.train()
    except (RuntimeError, ValueError, FileNotFoundError) as error:
        sys.exit(f"sb3_offline.zoo.train: {error}")


if __name__ == "__main__":
    main()
