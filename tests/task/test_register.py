"""The register of equations names what runs."""

import importlib
import types

import pytest

from projservo_cli.cli.equations import REGISTER
from projservo_cli.control import command
from projservo_cli.stages import calibrate, plan, servo


def uncompiled(value):
    """The function in Python that a compiled one was made of; anything else as it is."""
    return getattr(value, "py_func", value)


def names(code):
    """Names that a piece of code, or a function within it, looks up."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from names(constant)


def used(value):
    """What a function, or the methods of a class, look up by name, also as an attribute of a module."""
    value = uncompiled(value)
    if isinstance(value, type):
        for member in vars(value).values():
            yield from used(getattr(member, "fget", None) or getattr(member, "__func__", member))
    if not isinstance(value, types.FunctionType):
        return
    wanted = list(names(value.__code__))
    found = [value.__globals__[name] for name in wanted if name in value.__globals__]
    for module in [each for each in found if isinstance(each, types.ModuleType)]:
        found += [vars(module)[name] for name in wanted if name in vars(module)]
    for table in [each for each in found if isinstance(each, dict)]:
        found += table.values()
    yield from found


@pytest.fixture(scope="module")
def running():
    """Every function of the package that calibrating, planning or driving comes to call."""
    reached, left = set(), [calibrate.run, plan.run, servo.run, command]
    while left:
        value = uncompiled(left.pop())
        if not isinstance(value, (type, types.FunctionType)) or value in reached:
            continue
        if value.__module__.startswith("projservo_cli"):
            reached.add(value)
            left += used(value)
    return reached


@pytest.mark.parametrize("entry", REGISTER, ids=lambda entry: entry.number)
def test_registered_functions_are_those_that_run(entry, running):
    for dotted in entry.functions:
        module, name = dotted.rsplit(".", 1)
        assert uncompiled(getattr(importlib.import_module(module), name)) in running, dotted
