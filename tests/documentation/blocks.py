"""The fenced blocks of a page of Markdown, and running them as a reader would."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from projservo_cli import cli

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = {page.stem: page for page in sorted(DOCS.rglob("*.md")) if page.stem != "index"}
INDEXES = sorted(DOCS.rglob("index.md"))
FENCE = re.compile(
    r"(?:^<!-- not run: (?P<excuse>[^\n]*) -->\n)?"
    r"^```(?P<info>[^\n`]*)\n(?P<body>.*?)^```$",
    flags=re.MULTILINE | re.DOTALL,
)
CAPTIONED = re.compile(r"\A:caption: (?P<file>[\w.]+)\n(?P<text>.*)\Z", flags=re.DOTALL)
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
# What differs from run to run: how long something took.
TIME = re.compile(r"\b\d+(?:\.\d+)?(?= (?:ms|s|min)\b)")
# Other processors round otherwise: a page may be off by this share, and in counts of steps, which are not so
# few, by two.
SHARE, STEPS, FEW = 1e-2, 2, 20


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    language: str  # sh, python, text ..., or {name} of a directive
    text: str
    file: str  # name of the file it shows, empty for none
    excuse: str  # why it cannot be run, empty where it can
    follows: bool  # whether nothing but an empty line is between it and the block before


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


def matches(shown, printed):
    """Whether an output is part of what was printed, its numbers nearly so, whatever the line breaks."""
    (words, numbers), (all_words, all_numbers) = (_parts(text) for text in (shown, printed))
    start = all_words.find(words)
    while start >= 0:
        first = all_words.count("#", 0, start)
        if all(map(_near, numbers, all_numbers[first:])):
            return True
        start = all_words.find(words, start + 1)
    return False


def _parts(text):
    """Words with ``#`` for every number, and the numbers."""
    text = " ".join(TIME.sub("…", text.replace("#", "")).split())
    return NUMBER.sub("#", text), NUMBER.findall(text)


def _near(a, b):
    """Whether a number is another, but for rounding."""
    off = abs(float(a) - float(b))
    most = max(abs(float(a)), abs(float(b)))
    steps = a.isdigit() and b.isdigit() and most > FEW
    return off <= max(STEPS * steps, SHARE * most)


def run_page(page, read):
    """Write the files of a page, run its commands and its Python, and compare the outputs it shows.

    An output stands in a block of text right after commands or Python, and is part of what they print;
    ``read`` returns what was printed since it was last called. Returns the names that the Python defines.
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
            read()
            exec(compile(block.text, page.name, "exec"), names)
            printed = read()
        elif block.language == "text" and block.follows:
            assert matches(block.text, printed), printed
    return names
