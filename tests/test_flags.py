"""Flags of the compiler that tests set are those that the installed XLA knows."""

import os
import subprocess
import sys

from conftest import ACCEPTED, QUICK, accepted_flags


def test_unknown_flags_are_left_out():
    known = os.environ.get(ACCEPTED, "").split()
    assert set(known) <= set(QUICK)
    assert set(accepted_flags((*known, "--xla_no_such_flag=1"))) == set(known)


def test_accepted_flags_start_jax():
    flags = {**os.environ, "XLA_FLAGS": os.environ.get(ACCEPTED, "")}
    subprocess.run([sys.executable, "-c", "import jax; jax.devices()"], env=flags, check=True)
