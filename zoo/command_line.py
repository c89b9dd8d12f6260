"""What all commands share: how a command line is read, and how what is wrong with it is told."""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from errno import EISDIR
from os import strerror
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NoReturn

import gymnasium as gym
import torch as th

from sb3_kfcv.common.naming import unknown_name

BAD_INPUT = 2  # exit status, as of argparse
SIGNALLED = 128  # plus the number of the signal: 130 after Ctrl-C, 143 after SIGTERM
INTERRUPTED = SIGNALLED + 2

# What is wrong before any time is spent is told in one sentence.
REFUSALS = (ValueError, MemoryError, gym.error.Error)

CONSOLE_SCRIPT = "sb3-kfcv"

# Further words of a flag that takes several, and may be given again.
SEVERAL: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
PAIRS: dict[str, Any] = {**SEVERAL, "metavar": "KEY:VALUE"}


class Parser(argparse.ArgumentParser):
    """
    Says what is wrong in one sentence, by an exception.

    :param name: of the command, such as ``"train"``
    :param description: what it does
    :param examples: command lines to start from, without the command itself
    """

    def __init__(self, name: str, description: str, examples: Sequence[str] = ()) -> None:
        prog = shlex.join(this_command(name))
        epilog = "\n".join(["examples:", *(f"  {prog} {example}" for example in examples)]) if examples else None
        formatter = argparse.RawDescriptionHelpFormatter
        super().__init__(prog, description=description, epilog=epilog, allow_abbrev=False, formatter_class=formatter)

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)

    def parse_all(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """
        :raises ValueError: for bad usage; for an unknown flag, with the nearest one
        """
        args, unknown = self.parse_known_intermixed_args(argv)
        if unknown:
            raise ValueError(unknown_name("flag", unknown[0], [*self._option_string_actions]))
        return args


def whole_number(text: str) -> int:
    """A whole number, also as ``1e6``."""
    try:
        number = float(text)
        if number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f'"{text}" is no whole number')


def device(text: str) -> str:
    """The name of a PyTorch device, or ``auto``."""
    try:
        return text if text == "auto" else str(th.device(text))
    except RuntimeError:
        raise argparse.ArgumentTypeError(f'"{text}" is no device; give auto, cpu or cuda') from None


def as_typed(path: Path) -> str:
    """A path from the working directory, where it lies below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def this_command(name: str) -> list[str]:
    """
    A command as one types it: by the console script where that is how this process was started, else by its file.

    :param name: of the command, such as ``"train"``
    """
    if Path(sys.argv[0]).stem == CONSOLE_SCRIPT:
        return [CONSOLE_SCRIPT, name]
    return [as_typed(Path(sys.executable)), as_typed(Path(__file__).resolve().with_name(f"{name}.py"))]


def as_it_was_typed(name: str, argv: Sequence[str] | None) -> str:
    """
    The whole command line, to be written beside what it made.

    :param name: of the command
    :param argv: its words; by default those of the process
    """
    return shlex.join([*this_command(name), *(sys.argv[1:] if argv is None else argv)])


def require_writable(*files: str | Path) -> None:
    """
    Make the folders of files that are to be written, and see that they can be, before time is spent.

    :raises ValueError: if one cannot
    """
    for file in map(Path, files):
        try:
            if file.is_dir():
                raise IsADirectoryError(EISDIR, strerror(EISDIR))
            file.parent.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=file.parent):
                pass
        except OSError as error:
            raise ValueError(unwritable(file, error)) from None


def unwritable(path: str | Path, error: OSError) -> str:
    """Why a file or folder cannot be written, in one sentence."""
    return f"{path} cannot be written: {error.strerror or error}"


def refused(error: Exception) -> int:
    """
    Tell what is wrong.

    :param error: whose text is one sentence
    :return: exit status
    """
    print(f"error: {error}", file=sys.stderr)
    return BAD_INPUT


def show_warnings_plainly() -> None:
    """Print warnings as one sentence, without the place in the code that they come from."""

    def show(message: Warning | str, *_: Any) -> None:
        print(f"note: {message}", file=sys.stderr)

    warnings.showwarning = show  # type: ignore[assignment]


def start(main: Callable[[], int], interrupted: str = "interrupted") -> NoReturn:
    """
    Run a command as this process, and end with its exit status.

    :param main: the command
    :param interrupted: what to say after Ctrl-C
    """
    show_warnings_plainly()
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        sys.exit(INTERRUPTED)
