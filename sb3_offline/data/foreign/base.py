"""What a format of another library declares about itself."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from gymnasium import spaces

from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import Header


class Options(NamedTuple):
    """
    What the caller declares, for data that do not declare it themselves.

    :param observation_space: space of one observation
    :param action_space: space of one action
    :param max_episode_steps: time limit of the environment, in steps
    """

    observation_space: spaces.Space | None = None
    action_space: spaces.Space | None = None
    max_episode_steps: int | None = None


class Foreign(NamedTuple):
    """
    Data of another library, read into memory as the arrays of our format.

    :param header: spaces, attributes, and which arrays there are
    :param arrays: by name, as ``Header.fields`` names them
    """

    header: Header
    arrays: dict[str, Any]


class Scheme(NamedTuple):
    """
    Names that a library gives to its datasets in place of paths.

    :param prefix: text that such a name begins with, e.g. "minari:"
    :param locate: gives the path of the dataset with a name (without the prefix), whether or not it exists; raises
        ``DatasetError`` if it is no valid name
    :param pattern: regular expression of a name without the prefix, for the hint to a user who forgot the prefix
    :param download: command that downloads a dataset, with ``{name}`` for its name
    """

    prefix: str
    locate: Callable[[str], Path]
    pattern: str
    download: str


@dataclass(frozen=True)
class Format:
    """
    A format of another library.

    :param name: name of the format, for messages
    :param description: what its files contain, for messages: "an HDF5 file with ..."
    :param recognizes: whether a path or an object holds data of this format. It looks at the contents; no two formats may
        recognise the same data, unless one of them ``refines`` the other
    :param read: reads the data; raises ``DatasetError`` if they are damaged or need an option that was not given
    :param declares_spaces: whether the data say what their spaces are. If not, ``read`` takes them from the options or guesses
    :param unpickles: whether ``read`` unpickles files by a library that runs any code in them. These are checked before
    :param extra: extra of this package that installs what ``read`` and ``write`` import
    :param refines: names of more general formats that recognise these data too, e.g. "D4RL"
    :param scheme: names that stand for datasets of this format in place of paths
    :param write: writes a dataset (its header, its arrays by name) under a name of the scheme, completely or not at all
    """

    name: str
    description: str
    recognizes: Callable[[Probe], bool]
    read: Callable[[Probe, Options], Foreign]
    declares_spaces: bool
    unpickles: bool = False
    extra: str = ""
    refines: tuple[str, ...] = ()
    scheme: Scheme | None = None
    write: Callable[[Header, Mapping[str, Any], str], None] | None = None
