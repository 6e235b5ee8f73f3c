"""Download source distributions of other projects, for data and tests that are not in their wheels."""

import os
import subprocess
import sys
import tarfile
from pathlib import Path


def fetch(package: str, version: str, folder: Path) -> Path:
    """
    Download and unpack a source distribution, unless it is in the folder already.

    :param package: name on PyPI
    :param version: exact version
    :param folder: folder for the distribution
    :return: folder of the unpacked source distribution
    """
    root = folder / f"{package}-{version}"
    if not root.exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pip", "download", f"{package}=={version}", "--no-deps", "--no-binary", package]
        # pip builds the metadata even of a package that it only downloads, and some packages take their version from git
        names = (f"{tool}_PRETEND_VERSION_FOR_{package.upper()}" for tool in ("SETUPTOOLS_SCM", "VCS_VERSIONING"))
        environment = {**os.environ, **dict.fromkeys(names, version)}
        subprocess.run([*command, "--quiet", "--dest", str(folder)], check=True, env=environment)
        with tarfile.open(next(folder.glob(f"{package}-{version}.tar.*"))) as archive:
            archive.extractall(folder, filter="data")
    return root
