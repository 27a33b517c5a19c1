"""Names that pages give to those who call projservo from Python keep working.

Names stand in code and inline code, in references, and in tables of fields and columns. Each is stored beside
this file as an expression: ``calibration.predict(return_std=...)``, ``study.table['steps']``. The command
``python -m docs.generate`` adds those of new text. Only by hand is a name taken away, with a line in
CHANGELOG.md that says so.
"""

import ast
import inspect
import re
import typing
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import FunctionType, MethodType, UnionType

import pytest

import projservo_cli as ps
from docs.generate import REGION
from docs.generate.python import LAW
from projservo_cli.config import Config
from projservo_cli.robots.contract import Robot
from tests.documentation.blocks import FENCE, INDEXES, PAGES, ROOT, blocks_of
from tests.documentation.test_reference import resolved

STORED = Path(__file__).with_name("documented_names.txt")
# Results by the groups of the run file.
GROUPS = {
    "calibrate/observation": "observations",
    "calibrate/calibration": "calibration",
    "calibrate/cross_validation": "calibration.cross_validation",
    "plan": "plan",
    "servo/<law>": "trace",
    "report": "run.report",
}
# Generated parts of pages that name what Python users have.
DESCRIBED = ("python-interface", "robot-contract", "law-contract", "run-file-groups")
# Tables of results by the pages that name their columns.
COLUMNS = {"sweep-tables": "study.table", "observation-tables": "observations.to_frame()"}
# What code of pages calls otherwise.
OTHERWISE = {"projservo_cli": "ps", "projservo": "ps", "setup": "LawSetup"}
FILES = re.compile(r"\.(?:csv|gif|h5|html|json|pdf|py|yaml)$")
pytestmark = pytest.mark.volume


@cache
def values():
    """Results by the names that pages give them, and classes."""
    config = ps.Config.load("paper").replace({"stop.max_steps": 3, "calibration.frames_per_joint": 4})
    observations = ps.simulate(config)
    calibration = ps.calibrate(observations, cross_validate=2)
    plan = ps.plan(config, calibration)
    study = ps.sweep(config, laws=["exact", "direct_two"], tasks={"random": 1})
    return {
        "ps": ps,
        "config": config,
        "observations": observations,
        "calibration": calibration,
        "metric": calibration.metric(0.06, (0, 1)),
        "plan": plan,
        "trace": ps.servo(config, calibration, plan, law="exact"),
        "study": study,
        "run": ps.Experiment(config),
        **{kind.__name__: kind for kind in (*LAW, Robot)},
    }


@cache
def tables():
    """Tables and mappings, whose keys are names too, by the calls that return them."""
    known = values()
    observations, calibration, study = (known[name] for name in ("observations", "calibration", "study"))
    return {
        "calibration.residuals()": calibration.residuals(),
        "calibration.score()": calibration.score(observations),
        "observations.to_frame()": observations.to_frame(),
        "study.success()": study.success(),
        "study.paired()": study.paired("exact", "direct_two"),
        "study.table": study.table,
        "study.to_frame()": study.to_frame(),
        **{f"{name}.to_xarray()": known[name].to_xarray() for name in GROUPS.values() if name in known},
    }


def is_own(value):
    """Whether a value is of projservo, so that its names are."""
    kind = value if isinstance(value, type | FunctionType | MethodType) else type(value)
    return value is ps or (kind.__module__ or "").startswith("projservo_cli")


def hinted(hint):
    """A class of projservo that a type names, in a list or mapping of such; None for other types."""
    if isinstance(hint, type) and is_own(hint):
        return hint
    kinds = [found for part in typing.get_args(hint) if (found := hinted(part)) is not None]
    origin = typing.get_origin(hint)
    if not kinds or origin in (typing.Union, UnionType):  # a type of these or those is the first
        return kinds[0] if kinds else None
    return {"": kinds[0]} if issubclass(origin, Mapping) else kinds[:1]


def returned(function):
    """What a function or property returns, by its type."""
    return hinted(typing.get_type_hints(inspect.unwrap(function)).get("return"))


def member(value, name):
    """What an object has by a name, or a class for its objects."""
    if not isinstance(value, type):
        try:
            return getattr(value, name)
        except ps.InputError:  # it was not made: what is known is its type
            value = type(value)
    hints = typing.get_type_hints(value)
    if name in hints:
        return hinted(hints[name])
    found = inspect.getattr_static(value, name)
    function = getattr(found, "fget", getattr(found, "func", None))
    return returned(function) if function else getattr(value, name)


def known(path, value):
    """An expression and its value, by the name of that kind of results if there is one."""
    kind = value if isinstance(value, type) else type(value)
    same = [name for name, one in values().items() if kind in (one, type(one)) and is_own(kind)]
    return (same[0], values()[same[0]]) if same else (path, value)


def element(path, value):
    """The first of many; a table of many rows has the names of one."""
    if not isinstance(value, list | tuple) or not value:
        return path, None
    return known(path if path in tables() else f"{path}[0]", value[0])


def has_column(path, name):
    """Whether a table has a column or a property; a result that lacks a field has none of it."""
    table = tables()[path]
    table = table[0] if isinstance(table, list) else table
    field = getattr(values().get(path.removesuffix(".to_xarray()")), name, ...)
    lacks = field is None or (isinstance(field, tuple) and not field)
    return name in table or name in getattr(table, "attrs", ()) or lacks


class Reader(ast.NodeVisitor):
    """Finds the names of projservo in code, and those of them that do not work."""

    def __init__(self):
        self.found, self.broken, self.variables = set(), set(), {}

    def give(self, name, works):
        """Note a name."""
        self.found.add(name)
        if not works:
            self.broken.add(name)

    def value(self, node):
        """The expression of a node by the names of results, and its value; None if it is not of projservo."""
        match node:
            case ast.Name():
                return self.name(node)
            case ast.Attribute():
                return self.attribute(node)
            case ast.Call():
                return self.call(node)
            case ast.Subscript():
                return self.entry(node)
            case ast.Tuple() | ast.List():
                return "", [self.value(one)[1] for one in node.elts]
        self.generic_visit(node)
        return "", None

    def name(self, node):
        name = OTHERWISE.get(node.id, node.id)
        return self.variables.get(node.id) or (name, values().get(name))

    def attribute(self, node):
        if isinstance(node.value, ast.Name) and node.value.id == "self":  # of a law on a page
            return self.name(ast.Name(node.attr))
        path, value = self.value(node.value)
        if not is_own(value):
            return "", None
        path = f"{path}.{node.attr}"
        try:
            found = member(value, node.attr)
        except AttributeError:
            self.give(path, False)
            return path, None
        self.give(path, True)
        return (path, found) if value is ps else known(path, found)

    def call(self, node):
        path, function = self.value(node.func)
        for part in (*node.args, *(word.value for word in node.keywords)):
            self.value(part)
        if function is None or not is_own(function) or not callable(function):
            return "", None
        for word in node.keywords:
            self.argument(path, function, word.arg)
        if isinstance(function, type):
            return known("", function)
        return known(f"{path}()", tables().get(f"{path}()", returned(function)))

    def argument(self, path, function, name):
        """Note an argument that is given by name."""
        taken = inspect.signature(function).parameters
        any_name = any(one.kind is one.VAR_KEYWORD for one in taken.values())
        self.give(f"{path}({name}=...)", name in taken or any_name)

    def entry(self, node):
        self.value(node.slice)
        path, table = self.value(node.value)
        key = node.slice.value if isinstance(node.slice, ast.Constant) else None
        if isinstance(key, str) and isinstance(table, Mapping) and any(map(is_own, table.values())):
            return known(path, next(iter(table.values())))  # keys are data
        if isinstance(key, str) and path in tables():
            self.column(path, key)
        return element(path, table)

    def column(self, path, name):
        """Note a column of a table."""
        self.give(f"{path}[{name!r}]", has_column(path, name))

    def visit(self, node):
        return self.value(node) if isinstance(node, ast.expr) else super().visit(node)

    def bind(self, target, path, value):
        """Take what a variable is assigned, so that a name of a result may be one of other things."""
        if isinstance(target, ast.Tuple):
            for part in target.elts:
                self.bind(part, *element(path, value))
        elif isinstance(target, ast.Name):
            self.variables[target.id] = known(path, value)

    def visit_Assign(self, node):
        path, value = self.value(node.value)
        for target in node.targets:
            self.bind(target, path, value)

    def visit_For(self, node):
        self.bind(ast.Tuple([node.target]), *self.value(node.iter))  # takes the first of many
        self.generic_visit(ast.Module(node.body, []))

    def visit_comprehension(self, node):
        self.value(node.iter)


def parsed(text):
    """A text as an expression, or None."""
    try:
        return ast.parse(text, mode="eval").body
    except SyntaxError:
        return None


def described(reader, text):
    """Read the headings of references, and the lists, tables and words about what they have."""
    owner = part = ""
    for line in text.splitlines():
        part = line if line.startswith(("#", "**")) else part
        row = re.match(r"[|-] `([\w, ]+?)(_<view>)?`", line)
        if heading := re.match(r"#{2,4} (.+)$", line):
            code = re.fullmatch(r"`([\w.]+)(?:\((.*)\))?`", heading[1])
            owner = headed(reader, *code.groups()) if code else GROUPS.get(heading[1].replace("\\", ""), "")
        elif owner and row and (part == "**Attributes**" or line.startswith("|")):
            for name in row[1].split(", "):
                reader.value(parsed(f"{owner}.{name}"))
                if line.startswith("|") and f"{owner}.to_xarray()" in tables() and not row[2]:
                    reader.column(f"{owner}.to_xarray()", name)
        elif owner:
            worded(reader, owner, re.findall(r"`([A-Za-z]\w*)`", line))


def headed(reader, name, arguments):
    """Read the heading of a function or class, and return whose names follow."""
    places = {getattr(one, "__name__", type(one).__name__): place for place, one in values().items()}
    first, _, rest = name.partition(".")
    place = f"ps.{first}" if first in ps.__all__ else places.get(first, first)
    path, value = reader.value(parsed(f"{place}.{rest}" if rest else place))
    if arguments is None or value is None:
        return path
    taken = ast.parse(f"def f({arguments}): ...").body[0].args
    for argument in (*taken.args, *taken.kwonlyargs):
        reader.argument(path, value, argument.arg)
    return f"{places.get(first, place)}.{rest}()".replace(".()", "()")


def worded(reader, owner, names):
    """Read those names in the words about a class or function that it, or its result, has."""
    path, value = reader.value(parsed(owner))
    if isinstance(value, list):
        path, value = element(path, value)
    kind = value if isinstance(value, type) else type(value)
    fields = {*dir(kind), *typing.get_type_hints(kind)} if is_own(kind) else ()
    for name in names:
        if path in tables() and has_column(path, name):
            reader.column(path, name)
        elif path not in tables() and name in fields:
            reader.value(parsed(f"{path}.{name}"))


def columns(reader, text, table):
    """Read the first table of a page, whose rows are columns of a table of results, but for optional ones."""
    rows = [line for line in text.partition("\n## ")[0].splitlines() if line.startswith("| `")]
    for _, cell, about, *_ in (row.split("|") for row in rows):
        for name in re.findall(r"`(\w+)`", cell):
            if not about.strip().startswith("optional") and name not in ("qN", "center_deviation_mm"):
                reader.column(table, name)


def inline(reader, text):
    """Read inline code that is Python of results: no key of a configuration, module or file."""
    sections = ((name, type(field.default)) for name, field in Config.model_fields.items())
    keys = {f"{name}.{key}" for name, section in sections for key in getattr(section, "model_fields", ())}
    for code in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text):
        called = code.partition("(")[0]
        node = parsed(code)
        if node is None or FILES.search(code) or called in keys or not re.match(r"[\w.]+\.", called):
            continue
        root = called.partition(".")[0]
        if OTHERWISE.get(root, root) in values() and root != "projservo" and not is_module(called):
            reader.value(node)


def is_module(name):
    """Whether a dotted name is a module, or of one."""
    try:
        return resolved(name.removeprefix("projservo_cli.")) is not None
    except (ImportError, AttributeError):
        return False


def read_pages():
    """The names of all pages, and those of them that do not work."""
    whole = Reader()
    for page in (ROOT / "README.md", *INDEXES, *PAGES.values()):
        reader, text = Reader(), page.read_text(encoding="utf-8")
        for block in blocks_of(page):
            if block.language == "python":
                reader.visit(ast.parse(block.text))
        reader.variables.clear()
        text = FENCE.sub("", text)
        for region in REGION.finditer(text):
            if region["name"] in DESCRIBED:
                described(reader, region[0])
        if page.stem in COLUMNS:
            columns(reader, text, COLUMNS[page.stem])
        inline(reader, text)
        whole.found |= reader.found
        whole.broken |= reader.broken
    return whole.found, whole.broken


def stored_names():
    """The names that are stored."""
    return STORED.read_text(encoding="utf-8").splitlines()


def test_names_of_the_pages_work_and_are_stored_and_those_they_ever_gave_still_work():
    found, broken = read_pages()
    assert broken == set()
    assert found - {*stored_names()} == set(), "python -m docs.generate"
    reader = Reader()
    for line in stored_names():
        reader.value(parsed(line))
    assert {*stored_names()} - (reader.found - reader.broken) == set()


def to_store():
    """The names that are stored and those of the pages, a line each."""
    return "\n".join(sorted({*stored_names()} | read_pages()[0])) + "\n"
