"""The one writer of HTML: pages from templates on one base, values escaped once, numbers, pictures within."""

import base64
import math
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from projservo_cli.report.style import power_of_ten

if TYPE_CHECKING:
    from jinja2 import Environment

_NONE = "\N{EN DASH}"  # replaces a missing number


def html_page(template: str, **values: Any) -> str:
    """Text of a page by the name of its template; a value that it names and is not given is an error."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": _number, "degrees": math.degrees}
    return environment


def embedded(content: bytes, media_type: str) -> str:
    """Address of a picture that lies within the page itself.

    A browser runs no script of an image and fetches nothing for it, SVG included (HTML, section 4.8.3):
    files may come from strangers.
    """
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"


def short(value: float | None, digits: int = 3) -> str:
    """A number with few digits, powers of ten set as such; a dash if there is none."""
    if value is None or not math.isfinite(value):
        return _NONE
    power = math.floor(math.log10(abs(value))) if value else 0
    whole = value == 0 or isinstance(value, (int, np.integer)) or digits <= power + 1 <= 6
    mantissa, sign, exponent = (f"{value:.0f}" if whole else f"{value:.{digits}g}").partition("e")
    text = f"{mantissa} × {power_of_ten(int(exponent))}" if sign else mantissa
    return text.replace("-", "\N{MINUS SIGN}")


def _number(value: Any, digits: int = 3) -> Markup:
    """A number for the eye that carries all of its digits for programs."""
    plain = value.item() if isinstance(value, np.generic) else value
    if plain is None or not math.isfinite(plain):
        return Markup(_NONE)
    return Markup('<data value="{}">{}</data>').format(repr(plain), short(plain, digits))
