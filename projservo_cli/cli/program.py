"""The command ``projservo``: one group whose stages chain, and the exit codes of errors."""

import atexit
import contextlib
import difflib
import inspect
import io
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn

import click
from click.shell_completion import CompletionItem, shell_complete

from projservo_cli.cli.output import visible
from projservo_cli.provenance import __version__

_DONE, FAILED, _MALFORMED, _INTERRUPTED = 0, 1, 2, 130
_COMPLETE = "_PROJSERVO_COMPLETE"
_COMING = threading.Event()  # an interrupt that was lost and is raised again
_LEFT_OUT = {"--suggest": "5"}  # default number of an option
_BY_OPTION = {  # what files of an ending are given by
    ".yaml": "a configuration is given as -c {}",
    ".yml": "a configuration is given as -c {}",
    ".csv": "a table is given as --data {}",
}
_FORMER = {"detect": {"--joints-csv": "--readings"}}  # former names of options, which work on


class _Stage(click.Command):
    """A command after whose name other stages may follow."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Further stages, and options."""
        named, group = ctx.obj, ctx.find_root().command
        stages = group.stages if isinstance(group, _Group) else []
        further = [name for name in stages if name.startswith(incomplete) and name not in named]
        return [*map(CompletionItem, further), *super().shell_complete(ctx, incomplete)]


class _Group(click.Group):
    """A group whose stages chain, and in which options may come anywhere and hold for the whole call.

    ``context.obj`` are the names of the commands that are called: of one, or of the stages of a chain,
    which are called as one command that takes the options of them all.
    """

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.stages: list[str] = []

    def stage(self, name: str, **settings: Any) -> Callable[[Callable[..., Any]], click.Command]:
        """Decorate like ``command`` one that chains with other stages, in the order of their definition."""
        self.stages.append(name)
        return self.command(name, cls=_Stage, options_metavar="[STAGE ...] [OPTIONS]", **settings)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of their definition."""
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Stages, then the others."""
        others = [name for name in self.commands if name not in self.stages]
        for title, names in (("Stages", self.stages), ("Other commands", others)):
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(80)) for name in names])

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Sort words from options, so that the name of the command comes first and its arguments last."""
        words, options, flags = self._sorted(ctx, args or ["--help"])
        for flag in ("--version", *([] if words else ["--help"])):
            if flag in flags:
                return super().parse_args(ctx, [flag])
        try:
            ctx.obj, arguments = self._named(words)
        except click.UsageError:
            if not ctx.resilient_parsing:  # that is completion, which offers nothing then
                raise
            ctx.obj, arguments = [], []
        used = {_flag(param) for name in ctx.obj for param in self.commands[name].get_params(ctx)}
        unused = [flag for flag in flags if flag not in used]
        if unused and not ctx.resilient_parsing:
            where = "; ".join(
                f"{flag} is of {', '.join(self._taking(flag))}" for flag in dict.fromkeys(unused)
            )
            raise click.UsageError(f"{', '.join(unused)}: not used by {' '.join(ctx.obj)}; {where}")
        return super().parse_args(ctx, [*ctx.obj[:1], *options, *(["--", *arguments] if arguments else [])])

    def _taking(self, flag: str) -> list[str]:
        """Names of the commands that take an option."""
        return [name for name, one in self.commands.items() if flag in map(_flag, one.params)]

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """One command, or a chain of stages as one."""
        name, command, rest = super().resolve_command(ctx, args)
        if len(ctx.obj) > 1 and command is not None:
            parts = [self.commands[stage] for stage in ctx.obj]
            name = " ".join(ctx.obj)
            command = _Stage(
                name,
                callback=command.callback,
                params=list({option.name: option for part in parts for option in part.params}.values()),
                help="\n\n".join(inspect.cleandoc(part.help or "") for part in parts),
                epilog="\n\n".join(part.epilog or "" for part in parts),
                options_metavar=command.options_metavar,
            )
        return name, command, rest

    def _sorted(self, ctx: click.Context, args: list[str]) -> tuple[list[str], list[str], list[str]]:
        """Words, options with their values, and their flags, separated by click's parser word by word."""
        # Of options of one name, as --frames, that of the command which is called comes last and counts.
        called = sorted(self.commands.values(), key=lambda command: command.name in args)
        params = [*self.params, *(param for command in called for param in command.params)]
        options = {param.name: param for param in params if isinstance(param, click.Option)}
        every = click.Command(None, params=[*options.values()])
        words: list[str] = []
        taken: list[str] = []
        flags: list[str] = []
        rest = [
            f"{word}={_LEFT_OUT[word]}" if word in _LEFT_OUT and not following.isdecimal() else word
            for word, following in zip(args, [*args[1:], ""], strict=True)
        ]
        former = {old: new for name, names in _FORMER.items() if name in args for old, new in names.items()}
        for i, (name, equals, value) in enumerate(word.partition("=") for word in rest):
            rest[i] = f"{former.get(name, name)}{equals}{value}"
        while rest:
            _, left, read = every.make_parser(ctx).parse_args(list(rest))
            flags += map(_flag, read)
            taken += rest[: len(rest) - len(left)]
            if taken[-1:] == ["--"]:
                return [*words, *left], taken[:-1], flags
            words += left[:1]
            rest = left[1:]
        return words, taken, flags

    def _named(self, words: Sequence[str]) -> tuple[list[str], list[str]]:
        """The stages, each once and in their order, or one other command; and its arguments."""
        if not words:
            raise click.UsageError(f"no command; one of {', '.join(self.commands)}")
        first, *rest = words
        if first in self.commands and first not in self.stages:
            return [first], rest
        for word in words:
            if by := _BY_OPTION.get(os.path.splitext(word)[1].lower()):
                raise click.UsageError(f"{word}: {by.format(word)}")
        # The report of a sweep, and a calibration of which a camera is fitted again.
        if first in ("report", "calibrate") and len(rest) == 1 and rest[0] not in self.commands:
            return [first], rest
        for word in words:
            if word not in self.commands:
                close = difflib.get_close_matches(word, self.commands, n=1)
                hint = f"did you mean {close[0]}? " if close else ""
                raise click.UsageError(f"no command {word!r}; {hint}commands: {', '.join(self.commands)}")
            if word not in self.stages:
                raise click.UsageError(f"{word} runs alone; it does not chain with {first}")
        return [name for name in self.stages if name in words], []

    def main(self, args: Sequence[str] | None = None, *_: Any, **__: Any) -> NoReturn:
        """Run the command line, or answer a shell that completes it, and leave with the exit code."""
        if _COMPLETE in os.environ:
            sys.exit(shell_complete(self, {}, "projservo", _COMPLETE, os.environ[_COMPLETE]))
        sys.unraisablehook = _raise_again
        ended: list[int] = []
        atexit.register(_abandon_threads, ended)  # the first to be registered is the last to be called
        ended.append(run(sys.argv[1:] if args is None else args))
        sys.exit(ended[0])


main = _Group(
    "projservo",
    help="Uncalibrated stereo visual servoing in projective space. The stages record, calibrate, plan, "
    "servo and report chain in one call; each first makes its missing inputs. Options may come anywhere.",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 80},
)
click.version_option(__version__, message="projservo %(version)s")(main)


def _flag(option: click.Parameter) -> str:
    """The long form of an option; click gives the help options in no order."""
    return max(option.opts, key=len)


def run(arguments: Sequence[str]) -> int:
    """Run the command line; 0 done, 1 the work failed, 2 unusable input, 130 interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without Greek letters is no reason to fail
            stream.reconfigure(errors="replace")
    try:
        code = _invoked(arguments)
        sys.stdout.flush()
        return code or _DONE
    except click.exceptions.Exit as end:  # after help and version
        return end.exit_code
    except click.UsageError as error:
        return _complain(error.format_message(), _MALFORMED)
    except KeyboardInterrupt:
        _COMING.clear()
        return _complain("interrupted", _INTERRUPTED)
    except BrokenPipeError:  # the reader of a pipe, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _DONE
    except Exception as error:
        return _failure(error, verbose="-v" in arguments or "--verbose" in arguments)


def _invoked(arguments: Sequence[str]) -> int | None:
    """Return the result of the requested command."""
    try:
        with main.make_context("projservo", list(arguments)) as context:
            code: int | None = main.invoke(context)
            return code
    except Exception:
        if _COMING.is_set():  # an interrupted step, such as a compilation, fails before it comes
            time.sleep(1.0)
        raise


def _failure(error: Exception, *, verbose: bool) -> int:
    from projservo_cli.records import InputError, WorkFailed

    if isinstance(error, InputError):
        return _complain(str(error), _MALFORMED)
    if isinstance(error, WorkFailed):
        return _complain(str(error), FAILED)
    if verbose:
        traceback.print_exception(error)
    what = " ".join(str(error).split())
    return _complain(
        f"internal error, {type(error).__name__}: {what} (-v shows where; please report it)", FAILED
    )


def _complain(text: str, code: int) -> int:
    """Write one line per finding, so that each can be searched and clicked."""
    for line in text.splitlines():
        click.echo(f"projservo: {visible(line)}", err=True)
    return code


def _abandon_threads(ended: Sequence[int]) -> None:
    """Leave with the exit code while a thread still waits, such as for a camera that gives nothing.

    If it came back to C++ while the interpreter ends, it would abort the process: exit code 134.
    """
    if ended and any(thread.daemon for thread in threading.enumerate()):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(ended[0])


def _raise_again(lost: "sys.UnraisableHookArgs") -> None:
    """Interrupt a moment later if Ctrl-C came in code that cannot raise, such as a finalizer."""
    if not issubclass(lost.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    _COMING.set()
    # Wherever there are signals, one to the process also interrupts what its main thread waits for.
    send = partial(os.kill, os.getpid()) if os.name == "posix" else signal.raise_signal
    timer = threading.Timer(0.01, send, (signal.SIGINT,))
    timer.daemon = True
    timer.start()
