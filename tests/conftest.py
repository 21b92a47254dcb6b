"""Fixtures that the tests of the commands share."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from small import small_trainer


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """The directory of a run from which others start."""
    folder = tmp_path_factory.mktemp("trained")
    small_trainer(folder, "trainer.updates=20").train()
    return folder


@pytest.fixture
def float64():
    """Double precision by default."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def in_process(tmp_path, monkeypatch, capfd):
    """`in_process(train)` runs that module's `main` here, from an empty directory, with the arguments that it is
    called with: (exit code, what it printed).
    """
    monkeypatch.chdir(tmp_path)

    def of(module):
        def call(*arguments: str) -> tuple[int, str]:
            monkeypatch.setattr(sys, "argv", [module.__name__, *arguments])
            code = 0
            try:
                module.main()
            except SystemExit as stop:
                code = stop.code
            printed = capfd.readouterr()
            return code, printed.out + printed.err

        return call

    return of
