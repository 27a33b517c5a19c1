"""The fenced blocks of a page of Markdown, and running them as a reader would."""

import importlib
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

from projservo_cli import cli

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(
    r"(?:^<!-- not run: (?P<excuse>[^\n]*) -->\n)?"
    r"^```(?P<info>[^\n`]*)\n(?P<body>.*?)^```$",
    flags=re.MULTILINE | re.DOTALL,
)
CAPTIONED = re.compile(r"\A:caption: (?P<file>[\w.]+)\n(?P<text>.*)\Z", flags=re.DOTALL)
NUMBER = re.compile(r"[-+±]?\d[\d.e+-]*")


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    language: str  # sh, python, text ..., or {name} of a directive
    text: str
    file: str  # name of the file it shows, empty for none
    excuse: str  # why it cannot be run, empty where it can
    follows: bool  # whether nothing but an empty line is between it and the block before


def imported(*names):
    """Extensions that the documentation is built with, as modules."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        return [importlib.import_module(f"extensions.{name}") for name in names]


def blocks_of(page):
    """All fenced blocks of a page in order."""
    text = page.read_text(encoding="utf-8")
    end = 0
    for match in FENCE.finditer(text):
        info, body = match["info"], match["body"]
        captioned = CAPTIONED.match(body) if info.startswith("{code-block}") else None
        language = info.removeprefix("{code-block} ") if captioned else info
        follows = end > 0 and not text[end : match.start()].strip()
        end = match.end()
        body, file = (captioned["text"], captioned["file"]) if captioned else (body, "")
        yield Block(language, body, file, match["excuse"] or "", follows)


def run_commands(text):
    """Run the lines of a block of commands; all must succeed."""
    for line in text.splitlines():
        program, *words = shlex.split(line, comments=True)
        assert program == "projservo", line
        assert cli.run(words) == 0, line


def masked(text):
    """Words of an output with ``#`` for every number, whatever the line breaks."""
    return " ".join(NUMBER.sub("#", text).split())


def run_page(page, read):
    """Write the files of a page, run its commands and its Python, and compare the outputs it shows.

    An output stands in a block of text right after the commands, and is part of what they print; ``read``
    returns what was printed since it was last called. Returns the names that the Python of the page defines.
    """
    names = {}
    printed = ""
    for block in blocks_of(page):
        if block.excuse:
            continue
        if block.file:
            Path(block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "sh":
            read()
            run_commands(block.text)
            printed = read()
        elif block.language == "python":
            exec(compile(block.text, page.name, "exec"), names)
        elif block.language == "text" and block.follows:
            assert masked(block.text) in masked(printed), printed
    return names
