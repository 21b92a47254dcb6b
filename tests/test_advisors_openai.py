"""The advisor at a chat endpoint, against a server on the loopback interface with all kinds of failures."""

from __future__ import annotations

import contextlib
import json
import re
import time
import traceback
from dataclasses import replace

import pytest
from chat_server import Handler, chat, serving
from rounds import history, plan, request

from pirl_rl.errors import AdvisorError
from pirl_rl.outer_loop.advisors import openai
from pirl_rl.outer_loop.advisors.openai import OpenAI
from pirl_rl.outer_loop.parsing import parse_plan

KEY = "sk-0123456789abcdef"


def silent(handler: Handler) -> None:
    handler.server.stop.wait(30)


def dripping(handler: Handler) -> None:
    """Send one byte at a time, each of them within any time-out between bytes."""
    handler.send_response(200)
    handler.end_headers()
    with contextlib.suppress(OSError):
        while not handler.server.stop.wait(0.02):
            handler.wfile.write(b" ")


def dripping_headers(handler: Handler) -> None:
    with contextlib.suppress(OSError):
        while not handler.server.stop.wait(0.02):
            handler.wfile.write(b"H")


def hang_up(handler: Handler) -> None:
    handler.connection.close()


@pytest.fixture
def server():
    with serving() as server:
        yield server


@pytest.fixture
def advisor(server, monkeypatch):
    monkeypatch.setenv("MY_CREDENTIAL", KEY)

    def make(**settings) -> OpenAI:
        url = f"http://127.0.0.1:{server.server_port}/v1/"
        return OpenAI(url, "some-model", key_variable="MY_CREDENTIAL", **settings)

    return make


@pytest.fixture
def waits(monkeypatch):
    """The list of waiting times in s, which are not really waited."""
    waited: list[float] = []
    monkeypatch.setattr(openai.time, "sleep", waited.append)
    return waited


def refused(advisor: OpenAI) -> str:
    """The message of the error, which like its causes must not hold the key."""
    with pytest.raises(AdvisorError) as caught:
        advisor.propose(request(history()))
    assert KEY not in "".join(traceback.format_exception(caught.value))
    error = caught.value
    while error is not None:
        assert KEY not in f"{error} {error.__dict__}"
        error = error.__context__
    return str(caught.value)


def test_an_answer(server, advisor):
    server.script = [(200, chat(json.dumps(plan("a"))), {})]
    parse_plan(advisor(temperature=0.5).propose(request(history())), history(), 1)
    [(path, headers, body)] = server.requests
    assert (path, headers["Authorization"]) == ("/v1/chat/completions", f"Bearer {KEY}")
    assert body == {
        "model": "some-model",
        "messages": [{"role": "user", "content": request(history()).prompt}],
        "temperature": 0.5,
    }


def test_the_second_time_the_errors_are_told(server, advisor):
    server.script = [(200, chat("{}"), {})]
    advisor().propose(replace(request(history()), errors=["round_note: missing"]))
    [(_, _, body)] = server.requests
    assert body.keys() == {"model", "messages"}
    assert "- round_note: missing\n" in body["messages"][0]["content"]


@pytest.mark.parametrize("failure", [(500, b"oops", {}), (429, b"slow down", {}), hang_up])
def test_passing_failures_are_tried_again(failure, server, advisor, waits):
    server.script = [failure, failure, (200, chat("fine"), {})]
    assert advisor().propose(request(history())) == "fine"
    assert waits == [1.0, 2.0]


def test_failures_that_last(server, advisor, waits):
    server.script = [(500, b"out of order", {})]
    assert "got 500 out of order, after 4 tries" in refused(advisor())
    assert waits == [1.0, 2.0, 4.0]


@pytest.mark.parametrize(
    ("header", "wait"),
    [("7", 7.0), ("0", 1.0), ("9" * 40, 60.0), ("soon", 1.0), ("²", 1.0)],
)
def test_a_server_says_when_to_come_back(header, wait, server, advisor, waits):
    server.script = [(429, b"", {"Retry-After": header}), (200, chat("fine"), {})]
    assert advisor().propose(request(history())) == "fine"
    assert waits == [wait]


def test_a_server_says_the_date(server, advisor, waits):
    date = time.strftime("%a, %d %b %Y %H:%M:%S GMT", time.gmtime(time.time() + 1_000))
    server.script = [(503, b"", {"Retry-After": date}), (200, chat("fine"), {})]
    advisor().propose(request(history()))
    assert waits == [60.0]


@pytest.mark.parametrize("way", [silent, dripping, dripping_headers])
def test_a_slow_server(way, server, advisor, waits):
    server.script = [way]
    assert "no answer within 0.3 s, after 2 tries" in refused(advisor(timeout=0.3, retries=1))


def test_nobody_there(server, advisor, waits):
    gone = advisor(retries=1)
    gone.url = "http://127.0.0.1:1/chat/completions"
    assert "no connection: ConnectError" in refused(gone)
    assert waits == [1.0]


DEEP = b"[" * 100_000
BAD = {
    "huge": ((200, chat("x" * 10_000_000), {}), "at most 2,000,000 bytes"),
    "not JSON": ((200, b"<html>", {}), "expected JSON"),
    "not text": ((200, bytes(range(128, 256)), {}), "expected JSON"),
    "deep": ((200, DEEP, {}), "expected JSON"),
    "digits": ((200, b"1" * 5_000, {}), "expected JSON"),
    "compressed": ((200, b"\x1f\x8b" + b"0" * 99, {"Content-Encoding": "gzip"}), "expected JSON"),
    "no choices": ((200, b'{"choices": []}', {}), r"choices\[0\]"),
    "a list": ((200, b"[]", {}), r"choices\[0\]"),
    "null": ((200, chat(None), {}), r"choices\[0\]"),
    "parts": ((200, chat([{"text": "{}"}]), {}), r"choices\[0\]"),
    "moved": ((302, b"", {"Location": "http://127.0.0.1:1/"}), "got 302"),
    "unknown": ((404, b"no such model\x1b[2J", {}), r"got 404 no such model \[2J$"),
    "echo": ((401, f"wrong key: {KEY}".encode(), {"X-Key": KEY}), r"got 401 wrong key: \[removed\]"),
    "cut echo": ((401, b"x" * (openai.EXCERPT - 5) + KEY.encode(), {}), "got 401 x+.{0,5}$"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_a_server_gets_wrong(case, server, advisor, waits):
    server.script, message = [BAD[case][0]], BAD[case][1]
    assert re.search(message, refused(advisor()))
    assert len(server.requests) == 1
    assert not waits


def test_an_echoed_key_leaves_the_answer(server, advisor, waits):
    server.script = [(500, KEY.encode(), {}), (200, chat(f"your key is {KEY}, half of it \ud800"), {})]
    assert advisor().propose(request(history())) == "your key is [removed], half of it ?"
    server.script = [(500, KEY.encode(), {})]
    assert "[removed]" in refused(advisor())


@pytest.mark.parametrize("key", ["", "  ", "two words here", "line\nbreak-123", "schlüssel-123"])
def test_keys_that_are_none(key, advisor, monkeypatch):
    ready = advisor()
    monkeypatch.setenv("MY_CREDENTIAL", key)
    with pytest.raises(ValueError, match="MY_CREDENTIAL") as caught:
        advisor()
    assert not key.strip() or key.strip() not in str(caught.value)
    with pytest.raises(AdvisorError, match="MY_CREDENTIAL"):
        ready.propose(request(history()))


def test_the_key_is_kept_nowhere(advisor):
    assert KEY not in repr(vars(advisor()))


@pytest.mark.parametrize(
    "url",
    ["ftp://host/v1", "host/v1", f"http://user:{KEY}@host", f"http://host/v1?key={KEY}", "http://"],
)
def test_addresses_that_are_none(url, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    with pytest.raises(ValueError, match="base_url") as caught:
        OpenAI(url, "m")
    assert KEY not in str(caught.value)


@pytest.mark.parametrize("setting", [{"timeout": 0}, {"retries": -1}])
def test_settings_that_are_none(setting, advisor):
    with pytest.raises(ValueError, match=next(iter(setting))):
        advisor(**setting)
