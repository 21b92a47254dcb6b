"""An advisor that asks a language model at a chat endpoint with OpenAI's protocol."""

from __future__ import annotations

import asyncio
import email.utils
import json
import os
import time
from typing import Any

from pirl_rl.errors import AdvisorError, ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.answer import one_line
from pirl_rl.outer_loop.prompt import request_text
from pirl_rl.outer_loop.redaction import REMOVED, SHORTEST

try:
    import httpx
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("advisor=openai needs httpx: pip install 'pirl_rl[tune]'", name="httpx") from error

MAX_RESPONSE = 2_000_000
"""Largest number of bytes of a response. It exceeds that of an answer, because JSON escapes characters and a response
has other entries."""

FIRST_WAIT = 1.0
"""Seconds before the first retry; the time is doubled before each further one."""

LONGEST_WAIT = 60.0
"""Largest number of seconds before a retry, even if the server asks for more."""

EXCERPT = 300
"""Number of characters of an error response that the error quotes."""


class _TemporaryFailure(Exception):
    """A failure after which the request may be repeated; the server asks to wait for `wait` seconds."""

    def __init__(self, reason: str, wait: float = 0.0):
        super().__init__(reason)
        self.wait = wait


class OpenAI:
    """Sends the prompt as one user message and returns the text of the first choice.

    The key is read from the environment for each request and removed from answers and errors.

    Args:
        base_url: address of the endpoint, such as http://localhost:8000/v1, to which /chat/completions is appended.
        model: name of the model.
        key_variable: name of the environment variable that holds the key.
        timeout: time in s for each try, from the connection to the last byte.
        retries: number of retries after refused or broken connections, time-outs and the statuses 429 and 5xx.
        temperature: temperature of the sampling; None for the server's default.

    Raises:
        ArgumentError: if an argument is out of its range, the address holds credentials or is no address, or the key is
            not in the environment.
    """

    def __init__(
        self,
        base_url: str,
        model: str,
        key_variable: str = "OPENAI_API_KEY",
        timeout: float = 120.0,
        retries: int = 3,
        temperature: float | None = None,
    ):
        if not timeout > 0 or retries < 0:
            raise ArgumentError(f"timeout, retries: expected timeout > 0 and retries >= 0, got {timeout} and {retries}")
        self.url = _endpoint(base_url)
        self.model, self.key_variable, self.temperature = model, key_variable, temperature
        self.timeout, self.retries = timeout, retries
        self._key()

    def propose(self, request: Request) -> str:
        try:
            key = self._key()
        except ValueError as error:
            raise AdvisorError(f"openai: {error}") from None
        try:
            return _without_key(self._ask(request_text(request), key), key)
        except AdvisorError as error:
            raise AdvisorError(f"openai: {_without_key(str(error), key)}") from None

    def _key(self) -> str:
        key = os.environ.get(self.key_variable, "").strip()
        if not key or not key.isascii() or not key.isprintable() or " " in key:
            state = "is not set" if not key else "holds characters that no key has"
            raise ArgumentError(f"key_variable: expected the key in the environment, but {self.key_variable} {state}")
        return key

    def _ask(self, text: str, key: str) -> str:
        body: dict[str, Any] = {"model": self.model, "messages": [{"role": "user", "content": text}]}
        if self.temperature is not None:
            body["temperature"] = self.temperature
        failures = 0
        while True:
            try:
                return _content(asyncio.run(self._post(body, key)))
            except _TemporaryFailure as failure:
                failures += 1
                if failures > self.retries:
                    raise AdvisorError(f"{failure}, after {failures} tries") from None
                time.sleep(min(max(FIRST_WAIT * 2 ** (failures - 1), failure.wait), LONGEST_WAIT))

    async def _post(self, body: dict[str, Any], key: str) -> bytes:
        """Post a request; returns the body of a response with status 200."""
        # An uncompressed response cannot exceed the limit while it is decoded.
        headers = {"Authorization": f"Bearer {key}", "Accept-Encoding": "identity"}
        try:
            # The time-outs of httpx restart with every byte, so they do not limit the whole request.
            async with (
                asyncio.timeout(self.timeout),
                httpx.AsyncClient(follow_redirects=False, timeout=None) as client,
                client.stream("POST", self.url, json=body, headers=headers) as response,
            ):
                content = await _read(response)
        except TimeoutError:
            raise _TemporaryFailure(f"no answer within {self.timeout:g} s") from None
        except httpx.TransportError as error:
            raise _TemporaryFailure(f"no connection: {type(error).__name__}: {error}") from None
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:  # certificates and proxies included
            raise AdvisorError(f"{type(error).__name__}: {error}") from None
        if response.status_code == 200:
            return content
        excerpt = one_line(_without_key(content.decode("utf-8", errors="replace"), key)[:EXCERPT])
        reason = f"expected status 200, got {response.status_code} {excerpt}".rstrip()
        if response.status_code == 429 or response.status_code >= 500:
            raise _TemporaryFailure(reason, _retry_after(response))
        raise AdvisorError(reason)


def _endpoint(base_url: str) -> str:
    """The address of the requests. Credentials in it are refused, because the configuration is written to files."""
    try:
        url = httpx.URL(base_url)
    except httpx.InvalidURL:
        url = httpx.URL("")
    if url.scheme not in ("http", "https") or not url.host or url.userinfo or url.query or url.fragment:
        raise ArgumentError(
            "base_url: expected http(s)://host[:port]/path without user, password or query, got another address"
        )
    return f"{base_url.rstrip('/')}/chat/completions"


async def _read(response: httpx.Response) -> bytes:
    content = bytearray()
    async for chunk in response.aiter_raw():
        content += chunk
        if len(content) > MAX_RESPONSE:
            raise AdvisorError(f"expected a response of at most {MAX_RESPONSE:,} bytes, got more")
    return bytes(content)


def _content(body: bytes) -> str:
    """The text of the first choice."""
    try:
        answer = json.loads(body)
    except (ValueError, RecursionError):
        raise AdvisorError("expected JSON from the server, got other text") from None
    try:
        content = answer["choices"][0]["message"]["content"]
    except (KeyError, IndexError, TypeError):
        content = None
    if not isinstance(content, str):
        raise AdvisorError("expected a text at choices[0].message.content of the response, got none")
    return content.encode("utf-8", errors="replace").decode()  # JSON may hold single surrogates


def _retry_after(response: httpx.Response) -> float:
    """The number of seconds that the server asks to wait, or 0 if it does not ask."""
    text = response.headers.get("Retry-After", "")
    if text.isascii() and text.isdigit():
        return float(text[:9])
    try:
        return max(0.0, email.utils.parsedate_to_datetime(text).timestamp() - time.time())
    except (ValueError, OverflowError):
        return 0.0


def _without_key(text: str, key: str) -> str:
    return text.replace(key, REMOVED) if len(key) >= SHORTEST else text  # local servers accept short words as keys
