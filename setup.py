"""Find the packages; ``setup.cfg`` holds everything else."""

from setuptools import find_packages, setup

# Two folders beside the package are installed inside it, so that the user's environment gets no generic name (`data_tools`,
# `zoo_configs`).
FOLDERS = {"sb3_offline.data_tools": "data_tools", "sb3_offline.zoo_configs": "zoo_configs"}

packages = set(find_packages(include=["sb3_offline", "sb3_offline.*"]))
for package, folder in FOLDERS.items():
    packages |= {package, *(f"{package}.{name}" for name in find_packages(folder))}

setup(packages=sorted(packages), package_dir={"sb3_offline": "sb3_offline", **FOLDERS})
