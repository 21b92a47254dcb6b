"""What the process asks of the machine it runs on."""

import platform
import subprocess
import sys

import pytest

FREE_AND_FILL = """
import resource
import numpy
from pirl_rl.machine import keep_freed_memory

if {kept}:
    keep_freed_memory()
numpy.ones({size})  # 64 MB, freed at once
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    numpy.ones({size})
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(kept: bool) -> int:
    code = FREE_AND_FILL.format(kept=kept, size=64 * 2**20 // 8)
    return int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left as they are")
def test_arrays_take_over_the_memory_of_those_that_were_freed():
    """Ten arrays of 64 MB touch at least 320 new pages, one of 2 MB for each 2 MB, unless they take over old ones."""
    assert page_faults(kept=False) >= 320
    assert page_faults(kept=True) < 100
