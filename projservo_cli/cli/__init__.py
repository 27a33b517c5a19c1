"""The command ``projservo``: options in any order, messages, exit codes; no mathematics.

Only click is imported here; a command imports what it needs when it runs.
"""

import _thread
import difflib
import importlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from projservo_cli.cli.commands import COMMANDS, allowed, help_text
from projservo_cli.cli.options import LEFT_OUT, OPTIONS, visible
from projservo_cli.version import __version__

DONE, FAILED, MALFORMED, INTERRUPTED = 0, 1, 2, 130


class _Projservo(click.Command):
    """A command whose words and options stand in any order, which chained click groups do not allow."""

    def main(self, args: Sequence[str] | None = None, *_: Any, **__: Any) -> NoReturn:
        """Run the command line, or answer a shell that completes it, and leave with the exit code."""
        self._main_shell_completion({}, "projservo")
        sys.unraisablehook = _interrupt_anew
        sys.exit(run(sys.argv[1:] if args is None else args))


def _interrupt_anew(lost: "sys.UnraisableHookArgs") -> None:
    """Interrupt a moment later where Ctrl-C came amid what cannot raise, such as the end of an object."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    timer = threading.Timer(0.01, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    """Interrupt the main thread, from another one, and wherever there are signals also what it waits for."""
    if os.name == "posix":
        os.kill(os.getpid(), signal.SIGINT)
    else:
        _thread.interrupt_main()


def _complete(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Words that may follow: commands, further stages, or files."""
    del parameter
    words = context.params.get("words") or ()
    if words and not (words[0] in COMMANDS and COMMANDS[words[0]].stage):
        return [CompletionItem(incomplete, type="file")]
    return [
        CompletionItem(name, help=command.summary)
        for name, command in COMMANDS.items()
        if name.startswith(incomplete) and name not in words and (command.stage or not words)
    ]


main = _Projservo(
    "projservo",
    params=[
        *OPTIONS.values(),
        click.Argument(["words"], nargs=-1, type=click.UNPROCESSED, shell_complete=_complete),
    ],
    add_help_option=False,
)


def run(arguments: Sequence[str]) -> int:
    """Run the command line; the exit code is 0, 1, 2 or 130 (see the module's constants)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without Greek letters is no reason to fail
            stream.reconfigure(errors="replace")
    try:
        code = _dispatch(list(arguments))
        sys.stdout.flush()
        return code
    except click.UsageError as error:
        return _complain(error.format_message(), MALFORMED)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of a pipe, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        return _failure(error, verbose="-v" in arguments or "--verbose" in arguments)


def _failure(error: Exception, *, verbose: bool) -> int:
    from projservo_cli.records import InputError, WorkFailed

    if isinstance(error, InputError):
        return _complain(str(error), MALFORMED)
    if isinstance(error, WorkFailed):
        return _complain(str(error), FAILED)
    if verbose:
        traceback.print_exception(error)
    what = " ".join(str(error).split())
    return _complain(
        f"internal error, {type(error).__name__}: {what} (-v shows where; please report it)", FAILED
    )


def _complain(text: str, code: int) -> int:
    """One line a finding, so that a message can be searched for and clicked on."""
    for line in text.splitlines():
        click.echo(f"projservo: {visible(line)}", err=True)
    return code


def _dispatch(arguments: list[str]) -> int:
    context = main.make_context("projservo", _with_values(arguments))
    given = {name for name in OPTIONS if context.get_parameter_source(name) is ParameterSource.COMMANDLINE}
    names, rest = _commands(context.params["words"])
    if "version" in given:
        click.echo(f"projservo {__version__}")
        return DONE
    if "help" in given or not (arguments or names):
        click.echo(help_text(names))
        return DONE
    if not names:
        raise click.UsageError(f"no command; one of {', '.join(COMMANDS)}")
    unused = [OPTIONS[name].opts[-1] for name in OPTIONS if name in given - allowed(names)]
    if unused:
        raise click.UsageError(f"{', '.join(unused)}: not used by {' '.join(names)}")
    of_sweep = names == ["report"] and bool(rest)
    module = "sweep" if of_sweep else "stages" if COMMANDS[names[0]].stage else names[0]
    command = importlib.import_module(f"projservo_cli.cli.{module}")
    run_command = command.run_report if of_sweep else command.run
    code: int = run_command(names, rest, context.params)
    return code


def _with_values(arguments: list[str]) -> list[str]:
    """Arguments in which an option whose number is left out has its value and takes no other word for it."""
    after = [*arguments, ""][1:]
    return [
        f"{word}={LEFT_OUT[word]}" if word in LEFT_OUT and not following.isdecimal() else word
        for word, following in zip(arguments, after, strict=True)
    ]


def _commands(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The stages, each once and in their order, or one other command and its arguments."""
    if not words:
        return [], []
    if words[0] in COMMANDS and not COMMANDS[words[0]].stage:
        most = COMMANDS[words[0]].most
        if most is not None and len(words) > 1 + most:
            raise click.UsageError(
                f"{words[0]} takes {most or 'no'} argument{'s' * (most > 1)}, got {' '.join(words[1:])}"
            )
        return [words[0]], list(words[1:])
    stages = [name for name, command in COMMANDS.items() if command.stage]
    if words[0] == "report" and len(words) == 2 and words[1] not in COMMANDS:  # of a sweep, not of a run
        return ["report"], [words[1]]
    for word in words:
        if word in COMMANDS and word not in stages:
            raise click.UsageError(f"{word} stands alone; it does not chain with {words[0]}")
        if word not in stages:
            close = difflib.get_close_matches(word, COMMANDS, n=1)
            hint = f"did you mean {close[0]}? " if close else ""
            raise click.UsageError(f"no command {word!r}; {hint}commands: {', '.join(COMMANDS)}")
    return [name for name in stages if name in words], []
