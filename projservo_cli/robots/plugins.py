"""Plug-in robots and laws: from the name a user gives (entry point, module:Class) to the object.

A name is ``module:Class``, or one that an installed package registers under the entry point groups
``projservo.plants`` and ``projservo.laws``. Looking a name up reads metadata alone; only ``make``
imports, so that reading a configuration or a run file never starts code.
"""

import difflib
import importlib
import inspect
import os
import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from projservo_cli.records import InputError, WorkFailed

GROUPS = {"plant": "projservo.plants", "law": "projservo.laws"}
_METHODS = {"plant": ("open", "read", "command", "stop", "close"), "law": ("__call__",)}
_OPTIONAL = {"plant": ("now", "truth", "release", "hold", "identity"), "law": ()}
_OWN_PLANTS = {"so101": "projservo_cli.hardware.so101:SO101"}  # that projservo brings along
DOTTED = r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*"
# How alike two names are of which one is a slip, from 0 to 1: of a letter in four or five.
_ALIKE = 0.8
TARGET = rf"^{DOTTED}:{DOTTED}$"


def registered(kind: str) -> dict[str, str]:
    """Names of a ``plant`` or ``law``, projservo's own and those of installed packages, with the classes."""
    targets = {point.name: point.value for point in metadata.entry_points(group=GROUPS[kind])}
    return targets | (_OWN_PLANTS if kind == "plant" else {})


def short_name(target: str) -> str:
    """Return the name of a class ``module:Class`` for messages: the short one of a plant of projservo."""
    return next((name for name, known in _OWN_PLANTS.items() if known == target), target)


def target_of(kind: str, name: str) -> str | None:
    """The class ``module:Class`` that a name stands for; None where it stands for none."""
    return name if re.match(TARGET, name) else registered(kind).get(name)


def find(kind: str, target: str) -> Any:
    """Import a class, or a function that makes objects.

    kind : ``plant`` or ``law``, for messages.
    target : ``module:Class``; modules are sought on the Python path, then in the working directory.
    Raises InputError if there is no such class or it lacks a method that its objects must have.
    """
    where = f"{kind} {target}"
    imported = _found(where, *target.split(":"))
    if isinstance(imported, type):
        _require_methods(where, imported, kind)
    return imported


def make(kind: str, target: str, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Import a class and make an object of it.

    kind, target : as for ``find``; arguments, options : of the call of the class.
    Raises InputError if there is no such class, it lacks a method or does not take the arguments; WorkFailed
    if the class fails when called.
    """
    return called(kind, target, find(kind, target), arguments, options)


def called(kind: str, target: str, factory: Any, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Call a class, or a function that makes objects; the object, which has all methods it must have.

    kind, target : as for ``find``, for messages. Raises as ``make`` does.
    """
    where = f"{kind} {target}"
    try:
        inspect.signature(factory).bind(*arguments, **options)
    except TypeError as error:
        given_by = f"{kind}.options" if kind == "plant" else "the setting it is given"
        raise InputError(f"{where}: does not take {given_by}: {error}") from error
    except ValueError:
        pass  # a class in C does not show its arguments; the call itself checks them
    try:
        result = factory(*arguments, **options)
    except InputError:  # says itself which option is wrong
        raise
    except Exception as error:
        raise WorkFailed(f"{where}: cannot be made: {what_failed(error)}") from error
    _require_methods(where, result, kind)
    return result


def takes(kind: str, target: str, name: str) -> bool:
    """Tell whether a class says that it takes an argument of a name; one that takes any does not say so."""
    try:
        return name in inspect.signature(find(kind, target)).parameters
    except ValueError:  # of a class in C
        return False


_BROUGHT: dict[str, Any] = {}  # classes of this process, by name


def _found(where: str, module: str, name: str) -> Any:
    if f"{module}:{name}" in _BROUGHT:
        return _BROUGHT[f"{module}:{name}"]
    if os.getcwd() not in sys.path:  # last, so that a file there never stands in for an installed module
        sys.path.append(os.getcwd())
    try:
        named: Any = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        if (
            isinstance(error, ModuleNotFoundError)
            and error.name
            and f"{module}.".startswith(f"{error.name}.")
        ):
            place = f"on the Python path or in {os.getcwd()}"
            raise InputError(f"{where}: there is no module {error.name} {place}") from error
        raise InputError(f"{where}: importing {module} failed: {what_failed(error)}") from error
    for step in name.split("."):
        if not hasattr(named, step):
            classes = [
                key for key, value in vars(named).items() if getattr(value, "__module__", "") == module
            ]
            near = difflib.get_close_matches(step, classes, n=1)
            hint = f"did you mean {near[0]}?" if near else f"classes: {', '.join(classes) or 'none'}"
            raise InputError(f"{where}: {module} has no {step}; {hint}")
        named = getattr(named, step)
    if not callable(named):
        raise InputError(f"{where}: is no class, but of type {type(named).__name__}")
    return named


def require_object(kind: str, target: str, instance: Any) -> None:
    """Refuse an object that lacks a method it must have, with an InputError."""
    _require_methods(f"{kind} {target}", instance, kind)


def name_of(named: Any) -> str:
    """Return ``module:Class`` of a class, of a function or of an object's class."""
    kind = named if hasattr(named, "__qualname__") else type(named)
    steps = [step for step in kind.__qualname__.split(".") if step.isidentifier()]
    return f"{kind.__module__}:{'.'.join(steps or [kind.__class__.__name__])}"


def bring(kind: str, named: Any) -> str:
    """Make a class that this process has be found by its name, which is returned."""
    target = name_of(named)
    _require_methods(f"{kind} {target}", named, kind)
    _BROUGHT[target] = named
    return target


def importable(named: Any) -> bool:
    """Whether another process finds a class by its name, unlike those of a notebook or a function."""
    module, path = sys.modules.get(named.__module__), named.__qualname__.split(".")
    imported: Any = module if getattr(module, "__file__", None) is not None else None
    for step in path:
        imported = getattr(imported, step, None)
    return imported is named


def _require_methods(where: str, owner: Any, kind: str) -> None:
    methods = _METHODS[kind]
    if kind == "plant" and not callable(getattr(owner, "read", None)) and brings_no_pixels(owner):
        methods = tuple("joints" if name == "read" else name for name in methods)
    lacking = [name for name in methods if not (callable(getattr(owner, name, None)) or _sets(owner, name))]
    if lacking:
        require_spelt(where, owner, lacking)
        raise InputError(
            f"{where}: lacks {', '.join(f'{name}()' for name in lacking)}; needed: {', '.join(methods)}"
        )
    for name in _OPTIONAL[kind]:
        if not hasattr(owner, name):
            require_spelt(where, owner, (name,))
        elif not callable(getattr(owner, name)):
            raise InputError(f"{where}: has {name}, which is to be a method; give it another name")


def brings_no_pixels(owner: object) -> bool:
    """Whether a robot class, or an object of it, reads joints alone and leaves images to projservo."""
    return callable(getattr(owner, "joints", None)) or _sets(owner, "joints")


def _sets(owner: object, name: str) -> bool:
    """Whether a class may give its objects an attribute as they are made; these are checked then."""
    kinds = owner.__mro__ if isinstance(owner, type) else ()
    codes = [getattr(vars(kind).get("__init__"), "__code__", None) for kind in kinds]
    codes += [inner for code in codes if code is not None for inner in code.co_consts]  # comprehensions
    used = {word for code in codes for word in getattr(code, "co_names", ())}
    return bool(used & {name, "setattr"}) or any("__getattr__" in vars(kind) for kind in kinds)


def require_spelt(where: str, owner: Any, names: Sequence[str]) -> None:
    """Refuse an object with an attribute that is spelt almost as one of the known ones.

    It would else count as one that the object does not have.

    Raises InputError if there is one whose right name is not there as well.
    """
    own = [name for name in dir(owner) if not name.startswith("_")]
    for name in own:
        near = difflib.get_close_matches(name, names, n=1, cutoff=_ALIKE)
        if near and near[0] not in own:
            raise InputError(f"{where}: has {name}, which is not in the contract; did you mean {near[0]}?")


def what_failed(error: BaseException) -> str:
    """An exception of somebody else's code in one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    if isinstance(error, SyntaxError) and error.filename:
        place = f" ({Path(error.filename).name}:{error.lineno})"
        error = SyntaxError(error.msg)
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {text}' if text else ''}{place}"
