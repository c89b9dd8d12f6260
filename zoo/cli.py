"""The console script ``sb3-kfcv``: all commands of the zoo by one name, wherever one works."""

from __future__ import annotations

import pkgutil
import sys
from collections.abc import Sequence

COMMANDS = {
    "train": "train an algorithm, or teams against each other",
    "enjoy": "watch a trained model play",
    "evaluate": "measure models and scripted policies: all metrics with intervals",
    "record_video": "film episodes, several in a grid, as MP4 or GIF",
    "plot": "learning curves of many runs, with intervals over seeds",
    "compare": "algorithms over worlds and seeds: means, intervals, who is better how often",
    "plot_curriculum": "what the curriculum did, and what it finds easy and hard",
    "match": "everybody of one team against everybody of another, with ratings",
    "optimize": "search for better hyperparameters",
    "sweep": "many runs from one file, on this machine or on a cluster",
    "reproduce": "every table and figure of the paper, on top of sweeps",
    "gallery": "a page of videos, curves, tables and commands, made from runs",
    "release": "a small model for playing, with its model card, made of the best of some runs",
    "demo": "three minutes of training, from nothing to a table and a film",
}

USAGE = """\
usage: sb3-kfcv COMMAND [FLAGS]

{commands}

sb3-kfcv COMMAND --help tells more. From a clone, python zoo/COMMAND.py is the same.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """
    The console script.

    :param argv: the command and its flags; by default those of the process
    :return: exit status of the command
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print(USAGE.format(commands="\n".join(f"  {name:{width}}  {what}" for name, what in COMMANDS.items())))
        return 0 if words else 2
    name = words[0].replace("-", "_").removesuffix(".py")
    if name not in COMMANDS:
        from sb3_kfcv.common.naming import unknown_name  # here, since the help needs no PyTorch

        print(f"error: {unknown_name('command', words[0], COMMANDS)}", file=sys.stderr)
        return 2
    from zoo.command_line import show_warnings_plainly

    show_warnings_plainly()
    try:
        return pkgutil.resolve_name(f"zoo.{name}:main")(words[1:])  # one of COMMANDS, imported when it is wanted
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
