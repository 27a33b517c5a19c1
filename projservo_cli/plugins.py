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

_GROUPS = {"plant": "projservo.plants", "law": "projservo.laws"}
_METHODS = {"plant": ("open", "read", "command", "stop", "close"), "law": ("__call__",)}
_OPTIONAL = {"plant": ("now", "truth", "release", "hold", "identity"), "law": ("error",)}
_OWN_PLANTS = {"so101": "projservo_cli.hardware.so101:SO101"}  # that projservo brings along
_DOTTED = r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*"
# How alike two names are of which one is a slip, from 0 to 1: of a letter in four or five.
_ALIKE = 0.8
TARGET = rf"^{_DOTTED}:{_DOTTED}$"


def registered_names(kind: str) -> dict[str, str]:
    """Names of a ``plant`` or ``law``, projservo's own and from installed packages, with the classes."""
    found = {point.name: point.value for point in metadata.entry_points(group=_GROUPS[kind])}
    return found | (_OWN_PLANTS if kind == "plant" else {})


def short_name(target: str) -> str:
    """Return the name of a class ``module:Class`` for messages: the short one of a plant of projservo."""
    return next((name for name, known in _OWN_PLANTS.items() if known == target), target)


def target_of(kind: str, name: str) -> str | None:
    """The class ``module:Class`` of a name; None if it has none."""
    return name if re.match(TARGET, name) else registered_names(kind).get(name)


def find(kind: str, target: str) -> Any:
    """Import a class, or a function that makes objects.

    kind : ``plant`` or ``law``, for messages.
    target : ``module:Class``; modules are sought on the Python path, then in the working directory.
    Raises InputError if there is no such class or it lacks a method that its objects must have.
    """
    where = f"{kind} {target}"
    found = _found(where, *target.split(":"))
    if isinstance(found, type):
        require_object(kind, target, found)
    return found


def make(kind: str, target: str, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Import a class and make an object of it.

    kind, target : as for ``find``; arguments, options : of the call of the class.
    Raises InputError if there is no such class, it lacks a method or does not take the arguments; WorkFailed
    if the class fails when called.
    """
    return called(kind, target, find(kind, target), arguments, options)


def called(kind: str, target: str, found: Any, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Call a class, or a function that makes objects; the object, which has all methods it must have.

    kind, target : as for ``find``, for messages. Raises as ``make`` does.
    """
    where = f"{kind} {target}"
    try:
        inspect.signature(found).bind(*arguments, **options)
    except TypeError as error:
        given = f"{kind}.options" if kind == "plant" else "the setting it is given"
        raise InputError(f"{where}: does not take {given}: {error}") from error
    except ValueError:
        pass  # a class in C does not show its arguments; the call itself checks them
    try:
        result = found(*arguments, **options)
    except InputError:  # says itself which option is wrong
        raise
    except Exception as error:
        raise WorkFailed(f"{where}: cannot be made: {what_failed(error)}") from error
    require_object(kind, target, result)
    return result


def takes(target: str, name: str) -> bool:
    """Tell whether the class of a robot names an argument that it takes; one that takes any names none."""
    try:
        return name in inspect.signature(find("plant", target)).parameters
    except ValueError:  # a class in C
        return False


_BROUGHT: dict[str, Any] = {}  # classes of this process, by name


def _found(where: str, module: str, name: str) -> Any:
    if f"{module}:{name}" in _BROUGHT:
        return _BROUGHT[f"{module}:{name}"]
    if os.getcwd() not in sys.path:  # last, so that a file there never replaces an installed module
        sys.path.append(os.getcwd())
    try:
        found: Any = importlib.import_module(module)
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
        if not hasattr(found, step):
            classes = [
                key for key, value in vars(found).items() if getattr(value, "__module__", "") == module
            ]
            near = difflib.get_close_matches(step, classes, n=1)
            hint = f"did you mean {near[0]}?" if near else f"classes: {', '.join(classes) or 'none'}"
            raise InputError(f"{where}: {module} has no {step}; {hint}")
        found = getattr(found, step)
    if not callable(found):
        raise InputError(f"{where}: is no class, but of type {type(found).__name__}")
    return found


def class_name(given: Any) -> str:
    """Return ``module:Class`` of a class, of a function or of an object's class."""
    kind = given if hasattr(given, "__qualname__") else type(given)
    steps = [step for step in kind.__qualname__.split(".") if step.isidentifier()]
    return f"{kind.__module__}:{'.'.join(steps or [kind.__class__.__name__])}"


def bring(kind: str, given: Any) -> str:
    """Make a class, or a function, that this process has be found by its name, which is returned."""
    target = class_name(given)
    if isinstance(given, type):  # the result of a function is checked later
        require_object(kind, target, given)
    _BROUGHT[target] = given
    return target


def importable(given: Any) -> bool:
    """Whether another process finds a class by its name, unlike classes of a notebook or a function."""
    module, path = sys.modules.get(given.__module__), given.__qualname__.split(".")
    found: Any = module if getattr(module, "__file__", None) is not None else None
    for step in path:
        found = getattr(found, step, None)
    return found is given


def require_object(kind: str, target: str, found: Any) -> None:
    """Refuse a class or an object that lacks a method it must have, with an InputError."""
    where = f"{kind} {target}"
    methods = _METHODS[kind]
    if kind == "plant" and not callable(getattr(found, "read", None)) and brings_no_pixels(found):
        methods = tuple("joints" if name == "read" else name for name in methods)
    lacking = [name for name in methods if not (callable(getattr(found, name, None)) or _sets(found, name))]
    if lacking:
        require_spelt(where, found, lacking)
        raise InputError(
            f"{where}: lacks {', '.join(f'{name}()' for name in lacking)}; needed: {', '.join(methods)}"
        )
    for name in _OPTIONAL[kind]:
        if not hasattr(found, name):
            require_spelt(where, found, (name,))
        elif not callable(getattr(found, name)):
            raise InputError(f"{where}: has {name}, which is to be a method; give it another name")


def brings_no_pixels(found: object) -> bool:
    """Whether a robot class, or an object of it, reads joints alone and leaves images to projservo."""
    return callable(getattr(found, "joints", None)) or _sets(found, "joints")


def _sets(found: object, name: str) -> bool:
    """Whether a class may give its objects an attribute as they are made; these are checked then."""
    kinds = found.__mro__ if isinstance(found, type) else ()
    codes = [getattr(vars(kind).get("__init__"), "__code__", None) for kind in kinds]
    codes += [inner for code in codes if code is not None for inner in code.co_consts]  # comprehensions
    used = {word for code in codes for word in getattr(code, "co_names", ())}
    return bool(used & {name, "setattr"}) or any("__getattr__" in vars(kind) for kind in kinds)


def require_spelt(where: str, found: Any, names: Sequence[str]) -> None:
    """Refuse an object with an attribute that is spelt almost as one of the known ones.

    It would else count as one that the object does not have.

    Raises InputError if there is one whose right name is not there as well.
    """
    own = [name for name in dir(found) if not name.startswith("_")]
    for name in own:
        near = difflib.get_close_matches(name, names, n=1, cutoff=_ALIKE)
        if near and near[0] not in own:
            raise InputError(f"{where}: has {name}, which is not in the contract; did you mean {near[0]}?")


def what_failed(error: BaseException) -> str:
    """An exception of external code in one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    if isinstance(error, SyntaxError) and error.filename:
        place = f" ({Path(error.filename).name}:{error.lineno})"
        error = SyntaxError(error.msg)
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {text}' if text else ''}{place}"
