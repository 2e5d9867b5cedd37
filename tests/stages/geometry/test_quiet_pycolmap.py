"""pycolmap leaves SIGTERM as it was."""

import subprocess
import sys

PROGRAM = "from rille.stages.geometry.colmap import pycolmap; import os, signal; os.kill(os.getpid(), signal.SIGTERM)"


def test_a_program_with_pycolmap_is_ended_without_a_word():
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (-15, "")
