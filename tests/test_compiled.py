"""The first step of all says what it is waiting for."""

import os
import subprocess
import sys

from sb3_kfcv.envs.compiled import NOTICE

DRAW = """
import numpy as np
from sb3_kfcv.envs import physics
physics.uniform(np.zeros(1, dtype=np.uint64), 0, 0.0, 1.0)
physics.clipped(0.0, 1.0)
"""


def test_compiling_is_told_once_and_then_never_again(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for expected in (f"{NOTICE}\n", ""):
        done = subprocess.run([sys.executable, "-c", DRAW], env=environment, capture_output=True, text=True, check=True)
        assert done.stdout == ""
        assert done.stderr == expected
