"""
The subcommands of ``sb3-offline``. Each is a thin module that parses its options, calls the library and prints.

A command ``do-it`` is a line of :data:`COMMANDS` and a module ``do_it`` with ``add_arguments(parser)`` and ``run(args)``. A
module is imported only when its command is chosen, so that the list of commands appears at once and a command needs only its
own packages.
"""

COMMANDS = {
    "collect": "roll out the scripted policies, with noise and aborted attempts",
    "collect-sac": "roll out trained SAC agents: data of the paper's kind",
    "train-sac": "train the agents that collect-sac rolls out",
    "select-sac": "select checkpoints of train-sac for collect-sac, and measure them",
    "examples": "draw success examples from a labelled dataset",
    "label": "find the successful episodes of a dataset by success examples, without labels",
    "inspect": "show the content of a dataset and likely mistakes in it",
    "check": "check files and runs for damage",
    "render": "draw the frames of a dataset again, with another size or camera",
    "convert": "compress or uncompress a dataset, or convert it from and to other libraries",
    "train": "train one policy",
    "evaluate": "measure how often a trained policy succeeds",
    "benchmark": "train and evaluate a grid of methods, tasks and seeds",
    "report": "make tables and figures from the results of a benchmark",
    "demo": "do everything in one go: collect, train, evaluate and report",
}
"""The help text of each command, by name."""
