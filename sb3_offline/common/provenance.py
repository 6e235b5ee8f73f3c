"""Which code makes what is left behind."""

import subprocess
from pathlib import Path

import sb3_offline


def current_commit() -> str:
    """:return: the commit that the code is of, with a + where the code differs from it; "unknown" outside of a repository"""
    root = Path(sb3_offline.__file__).parent.parent
    code = ["sb3_offline", "zoo_configs", "data_tools"]

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if not git("ls-files", "sb3_offline/version.txt"):
            return "unknown"  # the repository is of something else, in which this package is installed
        return git("rev-parse", "--short=9", "HEAD") + "+" * bool(git("status", "--porcelain", *code))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
