"""Nothing that is written down holds a secret of the environment."""

from __future__ import annotations

import json
import os
from typing import Any

NAMES = ("KEY", "TOKEN", "SECRET", "PASSWORD")
SHORTEST = 8
"""Characters of the shortest value that is taken for a secret; shorter ones are words of any text."""

REMOVED = "[removed]"


def redact(value: Any) -> Any:
    """The same text, or lists and mappings of text, without the values of environment variables of such names."""
    if isinstance(value, str):
        for secret in _secrets():
            value = value.replace(secret, REMOVED)
        return value
    if isinstance(value, dict):
        return {redact(name): redact(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [redact(entry) for entry in value]
    return value


def _secrets() -> list[str]:
    """As they are and as JSON writes them; longest first, since one may be part of another."""
    values = {
        value
        for name, value in os.environ.items()
        if len(value) >= SHORTEST and any(word in name.upper() for word in NAMES)
    }
    escaped = {json.dumps(value, ensure_ascii=ascii)[1:-1] for value in values for ascii in (True, False)}
    slashed = {value.replace("/", "\\/") for value in values | escaped}
    return sorted(values | escaped | slashed, key=len, reverse=True)
