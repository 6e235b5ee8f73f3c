"""RLDS folders of TensorFlow Datasets are recognised, and refused with the way to convert them."""

from typing import NoReturn

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Format, Options
from sb3_offline.data.foreign.probe import Probe

DESCRIPTIONS = ("dataset_info.json", "features.json")
RECORDS = ".tfrecord"
REMEDY = (
    "Read the episodes where tensorflow_datasets is installed, and write them with sb3_offline.DatasetWriter: for each "
    'episode of tfds.builder_from_directory(folder).as_dataset(split="all"), stack episode["steps"] into arrays and give them '
    "to writer.add_episode(observations, actions, rewards=rewards, terminated=is_terminal). The step with is_last holds the "
    "last observation, and no action"
)


def recognizes(probe: Probe) -> bool:
    """
    :param probe: a path or an object
    :return: whether it is a folder of TensorFlow Datasets, a folder of its versions, or a file of records
    """
    if probe.is_object:
        return False
    if probe.kind != "folder":
        return probe.kind == "other" and RECORDS in probe.path.name
    versions = [probe.path, *(probe.path / name for name in probe.names if name[:1].isdigit())]
    described = any(all((folder / name).is_file() for name in DESCRIPTIONS) for folder in versions)
    return described or any(RECORDS in name for name in probe.names)


def read(probe: Probe, options: Options) -> NoReturn:
    """
    :param probe: the folder
    :param options: not used
    :raises DatasetError: always, with the way to convert the data
    """
    problem = "is RLDS (TensorFlow Datasets), which cannot be read without TensorFlow"
    raise DatasetError(probe.path, "folder" if probe.kind == "folder" else "file", problem, REMEDY)


FORMAT = Format(
    name="RLDS",
    description=f"a folder with {', '.join(DESCRIPTIONS)} and *{RECORDS}*; recognised, not read",
    recognizes=recognizes,
    read=read,
    declares_spaces=False,
)
