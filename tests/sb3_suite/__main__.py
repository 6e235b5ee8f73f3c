"""
Run the test-suite of the installed Stable-Baselines3 with our algorithms in the place of SAC.

    python tests/sb3_suite [--algorithms cql iql ...] [-- pytest options]

The suite is not in the wheel: the source distribution of the same version is fetched. What is left out stands in
exclusions.py, with a reason each.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import stable_baselines3

from sb3_offline import ALGOS

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent.parent / "benchmarks"))
from sdist import fetch  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--algorithms", nargs="+", choices=ALGOS, default=list(ALGOS))
    parser.add_argument("--folder", type=Path, default=Path("runs/sb3_suite"), help="for the source distribution")
    parser.add_argument("pytest", nargs="*", help="options for pytest, after --")
    args = parser.parse_args()
    suite = fetch("stable_baselines3", stable_baselines3.__version__, args.folder).resolve()
    files = sorted(str(path) for path in (suite / "tests").glob("test_*.py") if "SAC" in path.read_text())
    failed = []
    for name in args.algorithms:
        print(f"== {name}", flush=True)
        environment = {**os.environ, "SB3_SUITE_ALGORITHM": name, "PYTHONPATH": str(HERE)}
        options = ["-q", "-p", "plugin", "-p", "no:cacheprovider", "-W", "ignore", "--rootdir", str(suite), *args.pytest]
        code = subprocess.run([sys.executable, "-m", "pytest", *options, *files], cwd=suite, env=environment).returncode
        failed += [name] if code else []
    print("failed: " + ", ".join(failed) if failed else "all passed")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
