"""Removal of the values of secret environment variables from text before it is written."""

from __future__ import annotations

import json
import os
from typing import Any

NAMES = ("KEY", "TOKEN", "SECRET", "PASSWORD")
"""An environment variable is secret if its name contains one of these words."""

SHORTEST = 8
"""Smallest number of characters of a secret; shorter values may be ordinary words."""

REMOVED = "[removed]"


def redact(value: Any) -> Any:
    """Remove the values of secret environment variables from a text, or from all texts of nested lists and mappings."""
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
    """The secret values and the forms in which JSON writes them, longest first, because one may contain another."""
    values = {
        value
        for name, value in os.environ.items()
        if len(value) >= SHORTEST and any(word in name.upper() for word in NAMES)
    }
    escaped = {json.dumps(value, ensure_ascii=ascii)[1:-1] for value in values for ascii in (True, False)}
    slashed = {value.replace("/", "\\/") for value in values | escaped}
    return sorted(values | escaped | slashed, key=len, reverse=True)
