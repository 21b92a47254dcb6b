"""An advisor behind any chat endpoint that speaks OpenAI's protocol."""

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
from pirl_rl.outer_loop.prompt import asked
from pirl_rl.outer_loop.redaction import REMOVED, SHORTEST

try:
    import httpx
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("advisor=openai needs httpx: pip install 'pirl_rl[tune]'", name="httpx") from error

MAX_RESPONSE = 2_000_000
"""Bytes of the longest response that is read; an answer may be escaped, and has company."""

FIRST_WAIT = 1.0
"""Seconds before the first retry; doubled before each further one."""

LONGEST_WAIT = 60.0
"""Seconds, also where a server asks for more."""

EXCERPT = 300
"""Characters of a server's refusal that the error quotes."""


class _Again(Exception):
    """A failure that may pass; `wait` in seconds is the server's wish."""

    def __init__(self, reason: str, wait: float = 0.0):
        super().__init__(reason)
        self.wait = wait


class OpenAI:
    """Asks with one user message and takes the first choice's text.

    The key is read from the environment when it is needed. It is kept nowhere, and struck out of answers and errors.

    Args:
        base_url: of the endpoint, such as http://localhost:8000/v1; /chat/completions is appended.
        model: its name there.
        key_variable: name of the environment variable that holds the key.
        timeout: seconds for each try, from connecting to the last byte.
        retries: further tries after refused or broken connections, time-outs and the statuses 429 and 5xx.
        temperature: of the sampling; None leaves it to the server.
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
            raise ArgumentError(f"expected timeout > 0 and retries >= 0, got {timeout} and {retries}")
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
            return _struck(self._ask(asked(request), key), key)
        except AdvisorError as error:
            raise AdvisorError(f"openai: {_struck(str(error), key)}") from None

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
            except _Again as failure:
                failures += 1
                if failures > self.retries:
                    raise AdvisorError(f"{failure}, after {failures} tries") from None
                time.sleep(min(max(FIRST_WAIT * 2 ** (failures - 1), failure.wait), LONGEST_WAIT))

    async def _post(self, body: dict[str, Any], key: str) -> bytes:
        """The body of a response with status 200."""
        # What is not compressed cannot grow while it is read.
        headers = {"Authorization": f"Bearer {key}", "Accept-Encoding": "identity"}
        try:
            # httpx's own time-outs start anew with every byte.
            async with (
                asyncio.timeout(self.timeout),
                httpx.AsyncClient(follow_redirects=False, timeout=None) as client,
                client.stream("POST", self.url, json=body, headers=headers) as response,
            ):
                content = await _read(response)
        except TimeoutError:
            raise _Again(f"no answer within {self.timeout:g} s") from None
        except httpx.TransportError as error:
            raise _Again(f"no connection: {type(error).__name__}: {error}") from None
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:  # also of certificates and proxies
            raise AdvisorError(f"{type(error).__name__}: {error}") from None
        if response.status_code == 200:
            return content
        excerpt = one_line(_struck(content.decode("utf-8", errors="replace"), key)[:EXCERPT])
        reason = f"expected status 200, got {response.status_code} {excerpt}".rstrip()
        if response.status_code == 429 or response.status_code >= 500:
            raise _Again(reason, _retry_after(response))
        raise AdvisorError(reason)


def _endpoint(base_url: str) -> str:
    """The address to post to; credentials in it would be kept with the configuration."""
    try:
        url = httpx.URL(base_url)
    except httpx.InvalidURL:
        url = httpx.URL("")
    if url.scheme not in ("http", "https") or not url.host or url.userinfo or url.query or url.fragment:
        raise ArgumentError(
            "base_url: expected http(s)://host[:port]/path without user, password or query, got another"
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
        raise AdvisorError("expected JSON from the server, got none") from None
    try:
        content = answer["choices"][0]["message"]["content"]
    except (KeyError, IndexError, TypeError):
        content = None
    if not isinstance(content, str):
        raise AdvisorError("expected a text at choices[0].message.content of the response, got none")
    return content.encode("utf-8", errors="replace").decode()  # JSON can hold halves of characters


def _retry_after(response: httpx.Response) -> float:
    """Seconds that the server asks to wait, 0 where it does not say."""
    text = response.headers.get("Retry-After", "")
    if text.isascii() and text.isdigit():
        return float(text[:9])
    try:
        return max(0.0, email.utils.parsedate_to_datetime(text).timestamp() - time.time())
    except (ValueError, OverflowError):
        return 0.0


def _struck(text: str, key: str) -> str:
    return text.replace(key, REMOVED) if len(key) >= SHORTEST else text  # a shorter one is a local server's dummy
