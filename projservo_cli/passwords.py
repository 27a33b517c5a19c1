"""Masks of passwords and tokens in displayed or stored texts."""

import re
from typing import Any

MASK = "***"
"""Replaces a password in displayed or stored texts."""
# Passwords of URLs (RFC 3986, section 3.2.1), which users write with slashes and @ too, unlike ports; and
# values of parameters.
_USERINFO = re.compile(r"://(?:([^\s/?#:@]*:)(?!\d*(?:[/?#\s]|$))\S*|[^\s/?#:@]*)@")
_PARAMETER = re.compile(
    r"""(?i)([?&](?:key|pass|pw|sig)=|(?<![^\s?&;#/"'=])[\w.-]*(?:token|passw|pwd|loginpas|user-pw|secret|api_?key"""
    r"""|signature|credential|auth)[\w.-]*=)[^\s&"']+?(?=[)\]:,.;']*(?:[\s&"]|$))"""
)


def masked(value: Any) -> Any:
    """A text without passwords and tokens of URLs; of mappings and lists, each value so."""
    if isinstance(value, str):
        value = _USERINFO.sub(lambda found: f"://{found[1] or ''}{MASK}@", value) if "://" in value else value
        return _PARAMETER.sub(rf"\1{MASK}", value) if "=" in value else value
    if isinstance(value, dict):
        return {key: masked(inner) for key, inner in value.items()}
    return type(value)(map(masked, value)) if type(value) in (list, tuple) else value
