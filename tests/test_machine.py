"""What the process asks of the machine it runs on."""

import subprocess
import sys

import pytest

FREE_AND_FILL = """
import resource
import numpy
from pirl_rl.machine import keep_freed_memory

print({kept} and keep_freed_memory())
numpy.ones({size})  # 64 MB, freed at once
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    numpy.ones({size})
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(kept: bool) -> tuple[bool, int]:
    code = FREE_AND_FILL.format(kept=kept, size=64 * 2**20 // 8)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    keeps, faults = done.stdout.split()
    return keeps == "True", int(faults)


def test_arrays_take_over_the_memory_of_those_that_were_freed():
    """A page has at most 2 MB, so that ten arrays of 64 MB touch at least 320 new ones, or take over old ones."""
    keeps, faults = page_faults(kept=True)
    if not keeps:
        pytest.skip("the C library does not keep memory")
    assert faults < 100
    assert page_faults(kept=False)[1] >= 320
