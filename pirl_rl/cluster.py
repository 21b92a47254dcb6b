"""The connection to Ray, which runs work on the machines of a cluster."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pirl_rl.errors import ArgumentError, ClusterError

REACHABLE = 5.0
"""Seconds in which a cluster must accept a connection; Ray itself would try for more than a minute."""


def require_ray(key: str) -> None:
    """Check that Ray is installed, without importing it.

    Args:
        key: the setting that needs Ray, for the message.

    Raises:
        ClusterError: Ray is not installed.
    """
    if importlib.util.find_spec("ray") is None:
        raise ClusterError(f"{key}: needs Ray, which is not installed: pip install 'pirl_rl[ray]'")


def check_address(address: str | None) -> None:
    """Check that an address has the form of one, see `connected`.

    Raises:
        ArgumentError: it has not.
    """
    host, _, port = (address or "auto").rpartition(":")
    if address not in (None, "auto") and not (host and port.isdecimal()):
        raise ArgumentError(f'address: expected null, "auto" or host:port of a Ray cluster, got {address!r}')


@contextmanager
def connected(address: str | None, cpus: int | None = None, show_output: bool = False) -> Iterator[Any]:
    """Connect this process to Ray during the block. A connection that exists already is used, and left open.

    Args:
        address: the address of a cluster, such as "10.0.0.1:6379", or "auto" for that to which this machine belongs;
            None starts a Ray of its own on this machine, which ends with the block.
        cpus: the number of processors that a Ray of its own may give away; default those of this machine.
        show_output: whether what the processes of the cluster print is printed here too.

    Yields:
        The module `ray`.

    Raises:
        ArgumentError: the address has not the form of one.
        ClusterError: Ray is not installed, or the cluster cannot be reached.
    """
    check_address(address)
    require_ray("address")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # otherwise equal lines of two runs are printed once
    ray: Any = importlib.import_module("ray")
    if ray.is_initialized():
        yield ray
        return
    if address not in (None, "auto"):
        _knock(address)
    # With None, Ray would look for a running cluster first.
    where = {"address": "local", "num_cpus": cpus, "include_dashboard": False} if address is None else {}
    try:
        ray.init(**{"address": address, **where}, logging_level=logging.ERROR, log_to_driver=show_output)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        reason = str(error).strip().partition("\n")[0]
        if address is None:
            raise ClusterError(f"cannot start Ray on this machine: {reason}") from None
        raise ClusterError(
            f"cannot connect to the Ray cluster at {address}: {reason}; one with a token needs RAY_AUTH_MODE=token "
            "in the environment here too"
        ) from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=REACHABLE).close()
    except (OSError, OverflowError) as error:
        raise ClusterError(f"address: expected a Ray cluster at {address}, but nothing answers: {error}") from None


def reason_of(error: BaseException) -> str:
    """Why work on a cluster failed, in one line.

    Args:
        error: an error of Ray. Those of Ray itself begin with what happened, and those that carry an error of the
            work have a traceback, whose last line says what went wrong.
    """
    cause = getattr(error, "cause", None)
    if isinstance(cause, BaseException):
        return f"{type(cause).__name__}: {str(cause).strip().partition(chr(10))[0]}"
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[-1 if getattr(error, "actor_init_failed", False) else 0].strip()
