"""From a command line to an exit status; every error becomes one line on stderr."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.exit_status import INTERRUPTED, interrupts
from polmvs.cli.flags import Command, UsageError, in_flags, parse
from polmvs.config import OptionGroup
from polmvs.errors import OptionError, PolmvsError, final_name, printable

logger = logging.getLogger(__name__)


def run(
    commands: Sequence[Command], prog: str, argv: Sequence[str] | None = None, about: str = ""
) -> int:
    """Run the command that a command line names.

    Parameters
    ----------
    commands : all commands; a single one without a name is the program itself.
    prog : name of the program.
    argv : the command line after the program's name; by default that of the process.
    about : description of the program, for its help.

    Returns
    -------
    The exit status: 0; 1: unusable input; 2: unusable command line; others of the command.
    """
    try:
        parsed = parse(commands, sys.argv[1:] if argv is None else argv, prog, about)
    except UsageError as error:
        _print(error.prog, f"error: {error.message} (see {error.prog} --help)")
        return OptionError.exit_status
    if parsed.show is not None:
        parsed.show()
        return 0
    assert parsed.command is not None
    assert parsed.call is not None
    return _execute(parsed.command, parsed.call, parsed.prog)


def script(
    file: str,
    doc: str | None,
    function: Callable[[Call, Any], int],
    groups: tuple[type[OptionGroup], ...],
) -> Callable[..., int]:
    """The ``main`` of a program with one command; it takes arguments or reads those of the process.

    Parameters
    ----------
    file, doc : of its module, for the name and, from the first line, the help.
    function, groups : as in :class:`polmvs.cli.flags.Command`.
    """
    help_text = (doc or "").partition("\n")[0].removesuffix(".")
    command = Command(help_text=help_text, run=function, groups=groups)
    return partial(run, (command,), Path(file).name)


def _execute(command: Command, call: Call, prog: str) -> int:
    try:
        options = call.get(TerminalOptions)
    except OptionError as error:
        _print(prog, f"error: {in_flags(str(error))}")
        return error.exit_status
    # Progress bars are not for --help.
    from polmvs.cli.terminal import Terminal

    with Terminal(options) as terminal:
        return guarded(lambda: _function(command)(call, terminal), terminal, prog)


def _function(command: Command) -> Callable[[Call, Any], int]:
    """The function of a command; its module is imported only now."""
    if not isinstance(command.run, str):
        return command.run
    module, _, name = command.run.partition(":")
    function: Callable[[Call, Any], int] = getattr(import_module(module), name)
    return function


def guarded(command: Callable[[], int], terminal: Any, prog: str) -> int:
    """Run a command; return its exit status or that of its error."""
    try:
        return _interruptible(command)
    except KeyboardInterrupt:
        kept = "; finished stages are kept, go on with --resume" if terminal.log else ""
        _complain(terminal, prog, f"interrupted{kept}")
        return INTERRUPTED
    except PolmvsError as error:
        _trace(logging.DEBUG)
        _complain(terminal, prog, f"error: {error}")
        return error.exit_status
    except BrokenPipeError:  # the reader of stdout has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        _trace(logging.DEBUG)
        place = f"{final_name(error.filename)}: " if error.filename else ""
        _complain(terminal, prog, f"error: {place}{error.strerror or error}.")
        return 1
    except ImportError as error:  # of a package, or of a library of the system that it needs
        _trace(logging.DEBUG)
        _complain(
            terminal, prog, f"error: {error}. Run 'polmvs doctor', which says what is missing."
        )
        return 1
    except Exception as error:
        from concurrent.futures.process import BrokenProcessPool

        if isinstance(error, BrokenProcessPool | MemoryError):
            _trace(logging.DEBUG)
            _complain(
                terminal,
                prog,
                "error: out of memory, or a worker was killed. Give `run.workers` 1.",
            )
            return 1
        _trace(logging.CRITICAL)
        where = f"; see {terminal.log}" if terminal.log else ""
        _complain(terminal, prog, f"internal error: {type(error).__name__}: {error}{where}")
        return 1


def _interruptible(command: Callable[[], int]) -> int:
    """Run a command. Libraries that an interrupt reaches make errors of their own of it."""
    try:
        return command()
    except Exception as error:
        if interrupts:
            _trace(logging.DEBUG)
            raise KeyboardInterrupt from error
        raise


def _trace(level: int) -> None:
    logger.log(level, "where it happened:", exc_info=True, extra={"file_only": True})


def _complain(terminal: Any, prog: str, message: str) -> None:
    line = in_flags(" ".join(message.split()))
    logger.error("%s", line, extra={"file_only": True})
    terminal.repeat_warnings()
    _print(prog, line)


def _print(prog: str, line: str) -> None:
    print(f"{prog}: {printable(line)}", file=sys.stderr)
